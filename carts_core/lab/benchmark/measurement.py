"""Measurements of runs, the results file with one JSON line per run, and timings of the solver's stages."""

import hashlib
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch

from ... import provenance
from ...errors import CartsError
from ...evaluation import start_positions
from ...files import OutputPath, append_line, write_text
from ...files.reading import TABLE, VALUES, parse_json, read_bytes
from ...imaging.working_image import working_size
from ...model.scene import Scene, SceneState
from ...networks.extractor import FeatureExtractor
from ...optimization import DescentSolver, FrameOptimizer, SolverSettings, SurfaceSolver
from ...recording import Sequence
from ...rendering import Renderer
from ...rendering.rasterizer import link_transforms, rasterize, vertices_in_camera
from ...resources import sample_sequence
from ...settings.serialization import to_plain
from ...settings.stages import Observe
from ...wording import counted
from .scope import METHODS, Run, Scope

TOLERANCE = 2.0
"""Tolerance of the normalized surface distance [px]."""
WIDE_TOLERANCE = 5.0
"""Tolerance of the second normalized surface distance [px]."""
_MEASURED = (
    "*.py",
    "imaging/**/*.py",
    "model/**/*.py",
    "recording/*.py",
    "evaluation/**/*.py",
    "networks/**/*.py",
    "optimization/**/*.py",
    "rendering/**/*.py",
    "settings/optimization.py",
    "settings/stages.py",
    "lab/baselines/networks.py",
    "lab/benchmark/conditions.py",
    "lab/benchmark/frame.py",
)


def code_fingerprint(patterns: tuple[str, ...] = _MEASURED) -> str:
    """SHA-256 of modules of the package, by default of those that affect estimates and scores."""
    return provenance.code_fingerprint(patterns)


def run_fingerprint(
    run: Run, scope: Scope, extractor: FeatureExtractor, source: str, baseline: str | None = None
) -> str:
    """SHA-256 of all inputs of a run except the machine.

    `source` is the fingerprint of images and kinematics, and `baseline` the SHA-256 of a baseline's weights.
    """
    method = METHODS[run.method]
    settings = to_plain(method.settings(scope.steps(run))) if method.settings else {}
    company = scope.calibration_frames if method.calibrated else scope.consecutive if method.as_sequence else 1
    parts = (settings, company, extractor.fingerprint, str(extractor.device), source, TOLERANCE, code_fingerprint())
    parts += (baseline,) if baseline is not None else ()
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


BEST_OF = (30, 50)
"""Step counts for which the tables have a row with the best iterate."""


@dataclass(frozen=True)
class Score:
    """Scores of an estimate."""

    loss: float | None
    """Loss; None for methods without a loss, or if losses of iterates are not comparable."""
    dice: float
    nsd: float
    """Normalized surface distance within `TOLERANCE`."""
    joint_mae_deg: float | None
    """Mean absolute error of measured revolute joints [deg]; None without true joint positions."""
    visible_joint_mae_deg: float | None
    """Mean absolute error of the joints that are determined by the image [deg]; None if the optimizer does not report
    these joints."""
    tip_depth_mm: float | None
    """Mean absolute depth error of the jaw tips [mm]; None without true joint positions, and for intermediate
    iterates."""
    seconds: float
    """Wall time from the arrival of the frame to this estimate [s], without scoring."""
    nsd_wide: float | None = None
    """Normalized surface distance within `WIDE_TOLERANCE`; None for intermediate iterates, except the best iterates at
    the end and after the step counts of `BEST_OF`."""


@dataclass(frozen=True)
class Measurement:
    """Result of a run."""

    run: Run
    final: Score
    """Score of the method's result."""
    stopped: str
    """Termination reason of the optimization."""
    machine: str
    """Description of the machine."""
    trace: tuple[Score, ...] = ()
    """Scores of all iterates, beginning with the start; empty for methods without iterations."""
    best: tuple[int, ...] = ()
    """For each iterate, the index of the best iterate so far. It cannot be derived from the losses, since losses of
    different stages are not comparable."""
    before: Score | None = None
    """Score of the start, if the trace does not begin with the start."""
    verdict: str | None = None
    """`good`, `doubtful` or `failed`, if the method assesses its result."""
    probability: float | None = None
    """Probability that the mask is wrong [1]."""
    within: tuple[int, int, int] | None = None
    """Number of joint positions with ground truth and standard deviation, and numbers of errors within one and two
    standard deviations."""

    @property
    def start(self) -> Score | None:
        """Score of the initial estimate; None for methods without an initial estimate."""
        return self.before or (self.trace[0] if self.trace else None)

    @property
    def iterations(self) -> int:
        """Number of steps."""
        return max(len(self.trace) - 1, 0)

    @property
    def made_worse(self) -> bool:
        """Whether Dice decreased by more than 0.01."""
        return self.start is not None and self.final.dice < self.start.dice - 0.01

    def best_of(self, iterations: int) -> Score | None:
        """Score of the best iterate within a number of steps; None if the run was shorter because of its limit.

        The `seconds` of the score include all these steps.
        """
        if not self.trace or (iterations > self.iterations and self.stopped == "iterations"):
            return None
        last = min(iterations, self.iterations)
        return replace(self.trace[self.best[last]], seconds=self.trace[last].seconds)

    def best_so_far(self) -> list[Score]:
        """For each iterate, the score of the best iterate so far."""
        return [self.trace[place] for place in self.best]

    def to_json(self) -> dict[str, Any]:
        """Convert the measurement to JSON values; the trace is stored by column, which shortens the line."""
        entry = _rounded(asdict(self))
        columns = {field.name: [score[field.name] for score in entry["trace"]] for field in fields(Score)}
        return entry | {"trace": columns}

    @staticmethod
    def from_json(line: Mapping[str, Any]) -> "Measurement":
        """Convert the result of `to_json` to a measurement.

        Raises:
            KeyError, TypeError, ValueError: the line is not a measurement.
        """
        columns = dict(line["trace"])
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        found = msgspec.convert({**line, "trace": rows}, Measurement)
        if len(found.best) != len(rows) or not all(0 <= place <= index for index, place in enumerate(found.best)):
            raise ValueError(f"best is {found.best}, but there are {len(rows)} iterates")
        return found


def _rounded(value: Any) -> Any:
    """Nested values, rounded to six digits."""
    match value:
        case float():
            return round(value, 6)
        case dict():
            return {name: _rounded(part) for name, part in value.items()}
        case list() | tuple():
            return [_rounded(part) for part in value]
    return value


class ResultsFile:
    """File of measurements with one line of JSON each; a killed process loses at most the last line.

    Raises:
        CartsError: the file cannot be read.
    """

    def __init__(self, path: OutputPath) -> None:
        self.path = path
        self._known: dict[tuple[Run, str], Measurement] = {}
        self.unreadable = 0
        """Number of lines that are truncated or written by another version."""
        try:
            lines = read_bytes(path.path, TABLE).splitlines() if path.path.exists() else []
        except OSError as error:
            raise CartsError(
                f"{path} cannot be read ({error.strerror or error}). Choose another output folder."
            ) from error
        for line in lines:
            try:
                entry = json.loads(line)
                measurement = Measurement.from_json(entry)
                self._known[measurement.run, entry["fingerprint"]] = measurement
            except (KeyError, TypeError, ValueError):
                self.unreadable += 1

    def find(self, run: Run, fingerprint: str) -> Measurement | None:
        """Stored measurement of a run with the same fingerprint, or None."""
        return self._known.get((run, fingerprint))

    def append(self, measurement: Measurement, fingerprint: str, **also: str) -> None:
        """Append a measurement with its fingerprint and informative fields, and flush it to disk.

        Raises:
            OutputError: the file cannot be written.
        """
        entry = measurement.to_json()
        line = json.dumps({"fingerprint": fingerprint, **also, **entry}, separators=(",", ":"))
        append_line(self.path, line.encode())
        # The values are rounded as in the file, so that a report is the same before and after reading the file.
        self._known[measurement.run, fingerprint] = Measurement.from_json(entry)


_CUDA = "cuda: "


def machine(device: torch.device) -> str:
    """Description of processor, number of cores and threads, and, if used, the GPU."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    card = f", {_CUDA}{torch.cuda.get_device_name(device)}" if device.type == "cuda" else ""
    return f"{model}, {counted(os.cpu_count() or 1, 'core')}, torch threads: {torch.get_num_threads()}{card}"


def on_gpu(text: str) -> bool:
    """Whether a description from `machine` contains a GPU."""
    return _CUDA in text


def milliseconds(work: Callable[[], object], runs: int) -> float:
    """Median duration of a function [ms], after two warm-up calls."""
    for _ in range(2):
        work()
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def render_figures(sequence: Sequence, runs: int) -> dict[str, float]:
    """Timings of the renderer at the camera's full resolution [ms]."""
    camera = sequence.scene.cameras[0].name
    renderer = Renderer(sequence.scene, cameras=[camera])
    state = sequence.scene.with_cameras([camera]).state(sequence.frame(0, cameras=[camera]).measured)

    def forward() -> object:
        with torch.no_grad():
            return renderer(state)

    def both() -> None:
        free: SceneState = state.map(lambda value: value.detach().clone().requires_grad_())
        rendering = renderer(free)
        (rendering.image.sum() + rendering.silhouette.sum()).backward()

    with torch.no_grad():
        vertices = vertices_in_camera(renderer.geometry, link_transforms(renderer.scene, state)[0])
    faces, K = renderer.geometry.faces, state.intrinsics[0]
    surfaces = renderer.geometry.face_surfaces.numpy()
    size = (renderer.width, renderer.height)
    return {
        "visibility, compiled kernel": milliseconds(
            lambda: rasterize(vertices.T.numpy(), faces.numpy(), K.tolist(), *size, surfaces), runs
        ),
        "segmentation": milliseconds(lambda: renderer.segment(state), runs),
        "render forward": milliseconds(forward, runs),
        "render forward and backward": milliseconds(both, runs),
    }


def optimizer_figures(sequence: Sequence, iterations: int) -> dict[str, float]:
    """Timings of the optimizer on the first frame with an initial error of 2 degrees [ms]: the solver for the loss ACS,
    and the default solver."""
    camera = sequence.scene.cameras[0].name
    frame = sequence.frame(0, cameras=[camera])
    backgrounds = {camera: sequence.background(camera)}
    extractor = FeatureExtractor.load()
    start = start_positions(sequence, frame, 2.0, 0)

    def optimizer(settings: SolverSettings) -> FrameOptimizer:
        return FrameOptimizer(
            sequence.scene, frame, backgrounds, extractor, start=start, settings=settings, cameras=[camera], live=False
        )

    seconds = [iterate.seconds for iterate in optimizer(DescentSolver(iterations=iterations))][:-1]
    *steps, edges = [iterate.seconds for iterate in optimizer(SurfaceSolver())]
    return {
        "ACS iteration, median": 1e3 * statistics.median(seconds),
        "ACS iteration, 95th percentile": 1e3 * float(np.percentile(seconds, 95)),
        "Gauss-Newton iteration, median": 1e3 * statistics.median(steps),
        "alignment of outlines with edges": 1e3 * edges,
        f"Gauss-Newton, complete frame ({counted(len(steps), 'step')})": milliseconds(
            lambda: list(optimizer(SurfaceSolver())), 5
        ),
    }


_RUNS = 10


def stored(path: OutputPath, name: str, of: list[str]) -> Any:
    """Value `name` of a JSON file; None if the file is missing or was written for inputs other than `of`."""
    try:
        content = parse_json(read_bytes(path.path, VALUES))
        return content[name] if content["of"] == of else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def known_stages(path: OutputPath, extractor: FeatureExtractor) -> dict[str, float]:
    """Stored stage timings for this machine, weights and code."""
    return stored(path, "ms", _of(extractor)) or {}


def measure_stages(path: OutputPath, extractor: FeatureExtractor) -> None:
    """Time all stages on the CPU and write them to `path`, unless they are stored."""
    if known_stages(path, extractor):
        return
    sequence = Sequence.open(sample_sequence())
    figures = {
        **render_figures(sequence, _RUNS),
        **network_figures(sequence.scene, extractor),
        **optimizer_figures(sequence, _RUNS),
    }
    write_text(path, json.dumps({"of": _of(extractor), "ms": figures}, indent=1))


def network_figures(scene: Scene, extractor: FeatureExtractor) -> dict[str, float]:
    """Timings of the networks for whole images at the default resolutions of the optimizer [ms]."""
    settings = SurfaceSolver()
    scale = max(stage.scale for stage in settings.stages if isinstance(stage, Observe))
    width, height = working_size(scene, settings.working_width, extractor.stride)
    wide, high = working_size(scene, round(settings.working_width * scale), extractor.stride)
    image = torch.rand(1, 3, height, width, device=extractor.device)
    large = torch.rand(1, 3, high, wide, device=extractor.device)
    given = torch.rand(1, 6, high, wide, device=extractor.device)

    def forward() -> None:
        with torch.no_grad():
            extractor.features(image)

    def both() -> None:
        extractor.features(image.requires_grad_()).sum().backward()

    return {
        f"surface network forward, {wide}x{high}": milliseconds(lambda: extractor.surface(large, given), _RUNS),
        f"feature network forward, {width}x{height}": milliseconds(forward, _RUNS),
        f"feature network forward and backward, {width}x{height}": milliseconds(both, _RUNS),
    }


def _of(extractor: FeatureExtractor) -> list[str]:
    return [machine(extractor.device), extractor.fingerprint, code_fingerprint()]
