"""Networks of others as rows of the benchmark."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from carts_core.console import Bar, Terminal
from carts_core.files import output_path
from carts_core.imaging.working_image import Window
from carts_core.lab.baselines.networks import Baseline, TrainedBaseline, read_baseline, save_baseline
from carts_core.lab.benchmark import QUICK, Benchmark, Run, Source, plan
from carts_core.lab.benchmark.frame import GroundTruth, SourceBench, fitted
from carts_core.lab.benchmark.scope import BASELINES
from carts_core.lab.benchmark.statistics import Measurements
from carts_core.lab.benchmark.tables import main_tables
from carts_core.networks import FeatureExtractor
from carts_core.recording import Sequence
from carts_core.settings import Architecture
from carts_core.settings.training import BaselineName, BaselineNetwork

SMALLEST = {
    "unet": BaselineNetwork("unet", unet=Architecture(widths=(4, 6, 8, 8, 8), local_mean=False)),
    "colleoni": BaselineNetwork("colleoni", decoder=(8, 8, 8, 8, 8)),
}


class _Bright(Baseline):
    """Network that predicts bright pixels, and records its inputs."""

    def __init__(self, settings: BaselineNetwork) -> None:
        super().__init__(settings)
        self.inputs: list[tuple[torch.Tensor, torch.Tensor | None]] = []

    def forward(self, images: torch.Tensor, given: torch.Tensor | None = None) -> torch.Tensor:
        self.inputs.append((images, given))
        return images[:, :1] - 0.5


@pytest.mark.parametrize("name", ["unet", "colleoni"])
def test_images_of_another_aspect_ratio_are_not_squeezed(
    tiny_sequence: Callable[..., Path], extractor: FeatureExtractor, name: BaselineName
) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, width=320, height=180))
    image = np.zeros((180, 320, 3), np.uint8)
    cv2.circle(image, (200, 90), 60, (255, 255, 255), -1)
    mask, frame = image[..., 0] > 0, replace(sequence.frame(0), images={"left": image})
    network = _Bright(SMALLEST[name])
    source = Source("real", "", "left", [0], "", lambda progress: sequence)
    bench = SourceBench(source, Bar(), QUICK, extractor, {f"{name}_none": TrainedBaseline(network, {}, "")})
    found = bench._segment(Run("real", "regular", 0, f"{name}_none"), frame, GroundTruth("left", mask, {}, {}))
    ((images, given),) = network.inputs
    assert images.shape == (1, 3, 192, 256) and (given is None or given.shape == (1, 6, 192, 256))
    rows, columns = (images[0, 0] > 0.5).nonzero(as_tuple=True)
    assert float(columns.max() - columns.min()) == pytest.approx(float(rows.max() - rows.min()), abs=1)
    assert found.final.dice > 0.98


@pytest.mark.parametrize(
    ("image", "part", "border"),
    [
        ((640, 480), Window(0, 0, 256, 192), (0, 0, 0, 0)),
        ((1280, 720), Window(0, 24, 256, 144), (0, 0, 24, 24)),
        ((640, 512), Window(8, 0, 240, 192), (8, 8, 0, 0)),
    ],
)
def test_an_image_fills_the_input_of_a_network_as_far_as_its_aspect_ratio_allows(
    image: tuple[int, int], part: Window, border: tuple[int, int, int, int]
) -> None:
    assert fitted(image, (256, 192)) == (part, border)


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
