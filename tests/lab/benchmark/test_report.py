"""Reports, targets and verdicts from measurements made by hand."""

import csv
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from handmade import make_measurement, target_of

from carts_core.files import output_path
from carts_core.lab.benchmark import Facts, Measurement, Run, Score, targets, write_report
from carts_core.lab.benchmark.conditions import NO_ARM, contradicting_frame, with_other_instruments, wrong_inputs
from carts_core.lab.benchmark.hand_eye import HandEyeRun
from carts_core.lab.benchmark.statistics import Measurements
from carts_core.lab.benchmark.tables import main_tables
from carts_core.lab.synthesis import DOMAINS
from carts_core.recording import Sequence

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
    assert table.title == "Synthetic frames: Dice" and len(table.rows) == 7
    paper = next(row for row in table.rows if "best of 50" in row[0].text and "ACS" in row[0].text)
    assert paper[1].text == "92.0 ± 2.0" and paper[1].note == "S-Reg 96.6 ± 2.7"
    real = next(t for t in main_tables(Measurements(_measurements())) if t.title == "Real frames: Dice")
    assert real.rows[0][1].note == "R-Reg 95.0 ± 2.7"


def test_nothing_measured_gives_no_verdict_anywhere() -> None:
    assert all(target.met is None and target.reached == "not measured" for target in targets(Measurements([])))


def test_the_speedup_compares_the_times_to_the_papers_dice() -> None:
    paper = make_measurement((0.5, 0.6, 0.7, 0.8), method="paper", seconds=10.0)
    fast = make_measurement((0.5, 0.9), seconds=2.0)
    assert target_of("times faster", paper, fast).reached == "10.0"
    assert target_of("times faster", paper, fast).met is True
    slow = make_measurement((0.5, 0.9), seconds=6.0)
    assert target_of("times faster", paper, slow).met is False
    never = make_measurement((0.5, 0.75), seconds=0.1)
    assert target_of("times faster", paper, never).reached == "0.0"


def test_the_worst_domain_decides_on_dice() -> None:
    good = [make_measurement((0.6, 0.99), domain=domain, error_deg=2.0) for domain in DOMAINS[1:]]
    fine = make_measurement((0.6, 0.981), domain="regular", error_deg=2.0)
    bad = make_measurement((0.6, 0.97), domain="regular", error_deg=2.0)
    assert target_of("synthetic, 2° off, each frame alone: mean Dice", fine, *good).met is True
    part = target_of("synthetic, 2° off, each frame alone: mean Dice", fine)
    assert part.met is None and part.reached == "0.981" and "domains measured: 1" in part.basis
    missed = target_of("synthetic, 2° off, each frame alone: mean Dice", bad)
    assert missed.met is False
    missed = target_of("synthetic, 2° off, each frame alone: mean Dice", bad, *good)
    assert missed.met is False and missed.reached == "0.970" and "regular" in missed.basis


def _judged(
    dice: float, verdict: str, probability: float, frame: int = 0, source: str = "synthetic", domain: str = "regular"
) -> Measurement:
    found = make_measurement((0.85, dice), frame=frame, source=source, domain=domain)
    return replace(found, verdict=verdict, probability=probability, within=(10, 7, 9))


FRAMES = [
    _judged(0.97, "good", 0.02),
    _judged(0.93, "doubtful", 0.3, 1),
    _judged(0.0, "failed", 0.99, 2, domain=NO_ARM),
    _judged(0.7, "good", 0.05, 3),
]


def test_the_area_under_the_roc_is_how_often_a_wrong_mask_is_held_for_less_likely() -> None:
    # Wrong at 0.99 and 0.05, right at 0.02 and 0.3: three of four pairs are in order.
    assert target_of("verdict against Dice", *FRAMES).reached == "0.750"
    assert target_of("verdict against Dice", *FRAMES[:3]).met is True
    assert target_of("verdict against Dice", FRAMES[0], FRAMES[3]).met is None, "nothing was wrong about any input"


def test_what_is_wrong_about_an_input_is_what_its_name_says(tiny_sequence) -> None:
    path: Path = tiny_sequence(frames=4, cameras=("left", "right"), width=160, height=128)
    sequence = Sequence.open(path)
    right = sequence.frame(1, "regular")
    assert right.masks is not None
    empty, joints, image, instrument = (
        contradicting_frame(sequence, kind, 1, "left") for kind in wrong_inputs(4, 2, built_in=True)
    )
    assert empty.masks is not None and not empty.masks["left"].any()
    np.testing.assert_array_equal(empty.images["left"], sequence.background("left", "regular"))
    np.testing.assert_array_equal(joints.measured["PSM1"], sequence.frame(3, "regular").measured["PSM1"])
    np.testing.assert_array_equal(joints.images["left"], right.images["left"])
    np.testing.assert_array_equal(image.images["left"], right.images["right"])
    assert image.masks is not None
    np.testing.assert_array_equal(image.masks["left"], right.masks["right"])
    np.testing.assert_array_equal(instrument.images["left"], right.images["left"])
    assert instrument.truth is None
    (arm,), (other,) = sequence.scene.arms, with_other_instruments(sequence.scene, 1).arms
    assert other.robot.name != arm.robot.name and other.robot.joint_names == arm.robot.joint_names
