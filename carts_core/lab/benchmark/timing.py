"""Times of the parts of an optimization, each the median of repeated runs in one process."""

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

from ...evaluation import start_positions
from ...model.scene import SceneState
from ...networks import FeatureExtractor
from ...optimization import DescentSolver, FrameOptimizer, SolverSettings, SurfaceSolver
from ...recording import Sequence
from ...rendering import Renderer, visibility_torch
from ...rendering.geometry import link_transforms, vertices_in_camera
from ...rendering.rasterizer import rasterize
from ...wording import counted


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
