"""The report of measurements made by hand: complete, self-contained, the same in all its forms."""

import csv
import json
from html.parser import HTMLParser
from pathlib import Path

import pytest
from handmade import make_measurement

from carts_core.files import output_path
from carts_core.lab.benchmark import Facts, Measurement, Run, Score, write_report
from carts_core.lab.benchmark.hand_eye import HandEyeRun
from carts_core.lab.benchmark.statistics import Measurements
from carts_core.lab.benchmark.tables import main_tables
from carts_core.lab.synthesis import DOMAINS

HAND_EYE = [HandEyeRun("masks, 15 degrees and 10 cm", 0, 0.05, 0.001, "good")]
FACTS = Facts("quick", 200, {"synthetic": "seed 5 <b>"}, "abc", "def", "0.1")


def _measurements() -> list[Measurement]:
    found = []
    for source in ("synthetic", "real"):
        for domain in DOMAINS:
            for frame, dice in enumerate((0.9, 0.94)):
                unet = Score(None, 0.8, 0.7, None, None, None, 0.1)
                run = Run(source, domain, frame, "unet")
                found.append(Measurement(run, unet, "not iterative", "a machine"))
                place = {"source": source, "domain": domain, "frame": frame}
                found.append(make_measurement((0.8,), method="start", **place))
                for method in ("l1", "paper", "ours"):
                    found.append(make_measurement((0.8, 0.85, dice), method=method, **place))
    found += [make_measurement((0.6, 0.9), error_deg=float(error), frame=1) for error in range(4)]
    return found


class _Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.ids.add(value)
            if name in ("src", "href") and value:
                self.links.append(value)
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    assert (
        write_report(output_path(folder), _measurements(), FACTS, {"render forward": 3.25}, HAND_EYE)
        == folder / "report.html"
    )
    return folder


def test_the_page_has_all_sections_and_every_link_leads_somewhere(folder: Path) -> None:
    page = _Page((folder / "report.html").read_text())
    assert not page.open
    assert {"targets", "figures", "main-table", "iterations", "initial-error", "stages", "method"} <= page.ids
    assert {"figures/domains.svg", "figures/convergence.svg", "figures/errors.svg", "figures/scatter.svg"} <= set(
        page.links
    )
    for link in page.links:
        assert link.removeprefix("#") in page.ids if link.startswith("#") else (folder / link).is_file()


def test_the_page_says_what_is_missing_and_escapes_what_it_is_given(folder: Path) -> None:
    text = (folder / "report.html").read_text()
    assert "The benchmark is incomplete" in text
    assert "seed 5 &lt;b&gt;" in text
    assert "$" not in text


def test_json_and_csv_have_a_row_per_run_and_the_same_verdicts_as_the_page(folder: Path) -> None:
    document = json.loads((folder / "results.json").read_text())
    rows = list(csv.DictReader((folder / "results.csv").open()))
    assert len(rows) == len(document["runs"]) == document["measured"] == len(_measurements())
    assert rows[-1]["error_deg"] == "3.0" and float(rows[-1]["dice"]) == 0.9
    page = (folder / "report.html").read_text()
    for target in document["targets"]:
        assert f"<td>{target['reached']}</td>" in page
    assert not list(folder.rglob(".*"))


def test_the_main_table_has_mean_and_deviation_and_the_papers_number() -> None:
    table = main_tables(Measurements(_measurements()))[0]
    assert table.title == "Synthetic frames: Dice" and len(table.rows) == 6
    paper = next(row for row in table.rows if "best of 50" in row[0].text and "ACS" in row[0].text)
    assert paper[1].text == "92.0 ± 2.0" and paper[1].note == "S-Reg 96.6 ± 2.7"
    real = next(t for t in main_tables(Measurements(_measurements())) if t.title == "Real frames: Dice")
    assert real.rows[0][1].note == "R-Reg 95.0 ± 2.7"
