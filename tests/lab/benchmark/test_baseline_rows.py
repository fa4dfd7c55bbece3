"""Networks of others as rows of the benchmark."""

import json
from collections.abc import Callable
from pathlib import Path

from handmade import make_measurement

from carts_core.console import Terminal
from carts_core.files import output_path
from carts_core.lab.baselines.networks import Baseline, read_baseline, save_baseline
from carts_core.lab.benchmark import Benchmark, Measurement, Target, plan, targets
from carts_core.lab.benchmark.scope import BASELINES
from carts_core.lab.benchmark.statistics import Measurements
from carts_core.lab.benchmark.tables import main_tables
from carts_core.lab.synthesis import DOMAINS
from carts_core.settings import Architecture
from carts_core.settings.training import BaselineNetwork

SMALLEST = {
    "unet": BaselineNetwork("unet", unet=Architecture(widths=(4, 6, 8, 8, 8), local_mean=False)),
    "colleoni": BaselineNetwork("colleoni", decoder=(8, 8, 8, 8, 8)),
}


def test_rows_of_baselines_are_planned_where_weights_are_given_measured_and_in_the_table(
    tiny_benchmark: Callable[..., Benchmark], tmp_path: Path
) -> None:
    found = {}
    for name in ("unet", "colleoni"):
        path = output_path(tmp_path, f"{name}.safetensors")
        save_baseline(Baseline(SMALLEST[name]), path, {"augmentation": "none"})
        trained = read_baseline(path.path)
        found[trained.row] = trained
    plain = tiny_benchmark()
    sources = list(plain.sources.values())
    runs = [run for run in plan(plain.scope, sources, list(found)) if run.method in BASELINES]
    assert {run.method for run in runs} == {"unet_none", "colleoni_none"} and len(runs) == 4
    assert not [run for run in plan(plain.scope, sources) if run.method in BASELINES]
    bench = Benchmark(plain.scope, sources, plain.extractor, plain.results, runs, found)
    bench.run(Terminal())
    measured = bench.measurements()
    assert len(measured) == 4
    assert all(0 <= m.final.nsd <= (m.final.nsd_wide or 0) <= 1 and m.final.seconds > 0 for m in measured)
    tables = main_tables(Measurements(measured))
    labels = {table.title: [row[0].text for row in table.rows] for table in tables}
    assert [title for title in labels if "NSD" in title] == [
        "Synthetic frames: NSD at 2 px",
        "Synthetic frames: NSD at 5 px",
    ]
    assert all(rows[:2] == ["U-Net, no augmentation", "Colleoni's, no augmentation"] for rows in labels.values())
    assert json.loads(json.dumps(measured[0].to_json()))["final"]["nsd_wide"] == measured[0].final.nsd_wide


def _rows_of_two(networks: float, ours: float, least: float) -> list[Measurement]:
    """A U-Net, a Swin that is worse, Colleoni's, which sees a rendering, and ours; other figures under blood."""
    found = []
    for domain in DOMAINS:
        blood = domain == "bleeding"
        others = {"unet": networks, "swin_smoke": networks - 0.1, "colleoni_none": 0.999}
        for method, dice in (others | {"ours": ours}).items():
            value = least if blood and method == "unet" else dice
            found.append(make_measurement((0.5, value), method=method, domain=domain))
    return found


def test_how_far_ours_is_ahead_is_that_of_the_worst_shifted_domains() -> None:
    def target(*rows: Measurement) -> Target:
        (found,) = [one for one in targets(Measurements(rows)) if "best image-only network" in one.what]
        return found

    ahead = target(*_rows_of_two(0.98, 0.965, 0.6))
    # Of the networks Swin has the best worst domain; a network that is given a rendering does not count.
    assert (ahead.reached, ahead.met) == ("8.5 Dice points", True)
    against = "96.5 (CaRTS, ours, low brightness) against 88.0 (Swin, simulated smoke, low brightness)"
    assert ahead.basis == f"{against}; 1 frame, 2 networks"
    assert target(*_rows_of_two(0.98, 0.92, 0.6)).met is False
    some = [row for row in _rows_of_two(0.98, 0.965, 0.6) if row.run.domain != "smoke"]
    assert target(*some).met is None
    assert target(make_measurement((0.5, 0.9))).reached == "not measured"
