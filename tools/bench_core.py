"""`python -m tools.bench_core`: times and ratios of the core on the shipped sequence, measured on this machine.

Every figure is the median of repeated runs in one process; speed is a matter of the machine, the ratios less so.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.table import Table

from carts_core.console import Terminal
from carts_core.evaluation import start_positions
from carts_core.model.scene import SceneState
from carts_core.networks import FeatureExtractor
from carts_core.optimization import DescentSolver, FrameOptimizer, SolverSettings, SurfaceSolver
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer, visibility_torch
from carts_core.rendering.geometry import link_transforms, vertices_in_camera
from carts_core.rendering.visibility_numba import rasterize
from carts_core.resources import sample_sequence
from carts_core.wording import counted


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


def main() -> None:
    """Print the table."""
    tune_process(keep_memory=True)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence", nargs="?", type=Path, default=sample_sequence())
    parser.add_argument("--runs", type=int, default=30)
    arguments = parser.parse_args()
    sequence = Sequence.open(arguments.sequence)
    camera = sequence.scene.cameras[0]
    faces = sum(len(mesh.faces) for arm in sequence.scene.arms for mesh in arm.robot.meshes)
    arms = counted(len(sequence.scene.arms), "arm")
    table = Table(title=f"{sequence.name}: {arms}, {faces} triangles, {camera.width}x{camera.height}")
    table.add_column("what")
    table.add_column("ms", justify="right")
    for name, value in {
        **render_figures(sequence, arguments.runs),
        **optimizer_figures(sequence, arguments.runs),
    }.items():
        table.add_row(name, f"{value:.1f}")
    Terminal().print(table)


if __name__ == "__main__":
    main()
