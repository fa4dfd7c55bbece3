"""Times of the parts of an optimization on the shipped sequence, medians in one process, and the machine."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ...evaluation import start_positions
from ...files import OutputPath, write_text
from ...files.reading import VALUES, parse_json, read_bytes
from ...model.scene import Scene, SceneState
from ...networks import FeatureExtractor
from ...optimization import DescentSolver, FrameOptimizer, SolverSettings, SurfaceSolver
from ...optimization.inputs import working_size
from ...recording import Sequence
from ...rendering import Renderer, visibility_torch
from ...rendering.geometry import link_transforms, vertices_in_camera
from ...rendering.rasterizer import rasterize
from ...resources import sample_sequence
from ...settings.stages import Observe
from ...wording import counted
from .measurement import code_fingerprint

_CUDA = "cuda: "


def machine(device: torch.device) -> str:
    """Processor, cores, threads, and the graphics card that networks and solver run on, if they do."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    card = f", {_CUDA}{torch.cuda.get_device_name(device)}" if device.type == "cuda" else ""
    return f"{model}, {counted(os.cpu_count() or 1, 'core')}, torch threads: {torch.get_num_threads()}{card}"


def on_gpu(text: str) -> bool:
    """Whether `machine` wrote that a graphics card was used."""
    return _CUDA in text


def milliseconds(work: Callable[[], object], runs: int) -> float:
    """Median duration of `work` [ms], after two calls that do not count."""
    for _ in range(2):
        work()
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def render_figures(sequence: Sequence, runs: int) -> dict[str, float]:
    """Times of the renderer at the camera's full size [ms]."""
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
        "visibility, torch (as on a GPU)": milliseconds(lambda: visibility_torch(vertices.T, faces, K, *size), 5),
        "segmentation": milliseconds(lambda: renderer.segment(state), runs),
        "render forward": milliseconds(forward, runs),
        "render forward and backward": milliseconds(both, runs),
    }


def optimizer_figures(sequence: Sequence, iterations: int) -> dict[str, float]:
    """Times of the optimizer on the first frame [ms]: the paper's loss, and the default solver from 2 degrees off."""
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
        "drawing outlines to edges": 1e3 * edges,
        f"Gauss-Newton, a whole frame ({counted(len(steps), 'step')})": milliseconds(
            lambda: list(optimizer(SurfaceSolver())), 5
        ),
    }


_RUNS = 10


def known_stages(path: OutputPath, extractor: FeatureExtractor) -> dict[str, float]:
    """Figures that this machine and this code have written to `path`; none if there are no such."""
    try:
        stored = parse_json(read_bytes(path.path, VALUES))
        return stored["ms"] if stored["of"] == _of(extractor) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def measure_stages(path: OutputPath, extractor: FeatureExtractor) -> None:
    """Measure all stages, on the CPU, and write them to `path`, unless they are there."""
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
    """Times of the networks on whole images of the sizes that the optimizer compares by default [ms]."""
    settings = SurfaceSolver()
    scale = max(stage.scale for stage in settings.stages if isinstance(stage, Observe))
    width, height = working_size(scene, settings.working_width, extractor.stride)
    wide, high = working_size(scene, round(settings.working_width * scale), extractor.stride)
    image = torch.rand(1, 3, height, width, device=extractor.device)

    def forward() -> None:
        with torch.no_grad():
            extractor.features(image)

    def both() -> None:
        extractor.features(image.requires_grad_()).sum().backward()

    large = torch.rand(1, 3, high, wide, device=extractor.device)
    given = torch.rand(1, 6, high, wide, device=extractor.device)

    return {
        f"surface network forward, {wide}x{high}": milliseconds(lambda: extractor.surface(large, given), _RUNS),
        f"feature network forward, {width}x{height}": milliseconds(forward, _RUNS),
        f"feature network forward and backward, {width}x{height}": milliseconds(both, _RUNS),
    }


def _of(extractor: FeatureExtractor) -> list[str]:
    return [machine(extractor.device), extractor.fingerprint, code_fingerprint()]
