"""Networks of others as rows of the benchmark."""

import json
from collections.abc import Callable
from pathlib import Path

from carts_core.console import Terminal
from carts_core.files import output_path
from carts_core.lab.baselines.networks import Baseline, read_baseline, save_baseline
from carts_core.lab.benchmark import Benchmark, plan
from carts_core.lab.benchmark.scope import BASELINES
from carts_core.lab.benchmark.statistics import Measurements
from carts_core.lab.benchmark.tables import main_tables
from carts_core.settings import Architecture
from carts_core.settings.training import BaselineNetwork

SMALLEST = {
    "unet": BaselineNetwork("unet", unet=Architecture(widths=(4, 6, 8, 8, 8), local_mean=False)),
    "colleoni": BaselineNetwork("colleoni", decoder=(8, 8, 8, 8, 8)),
}


def test_baselines_with_weights_are_measured(tiny_benchmark: Callable[..., Benchmark], tmp_path: Path) -> None:
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
