"""The temporal pipeline of TC-CaRTS: each frame starts with the correction of the one before it."""

import time
from collections.abc import Iterable, Mapping

import numpy as np

from ...networks.extractor import FeatureExtractor
from ...optimization import Backgrounds, FrameOptimizer
from ...rendering import Renderer
from ...settings import DescentSolver
from .frame import Truth, start_of
from .measurement import Measurement
from .scope import Run
from .sources import Recording
from .timing import machine

STEPS = 10
"""Of each frame but the first. TC-CaRTS (arXiv 2212.00072) is said to need far fewer than CaRTS's 30."""


def correct_forwards(
    runs: Iterable[Run],
    recording: Recording,
    extractor: FeatureExtractor,
    truths: Mapping[int, Truth],
    renderer: Renderer,
    first: DescentSolver,
) -> list[Measurement]:
    """Correct frames in their order with ACS, each from its measured joints plus the previous frame's correction.

    This is the first of the three modules that TC-CaRTS adds (arXiv 2212.00072). What we have of that paper, its
    abstract, does not say enough of the others: a network that corrects kinematics, and a regularization.

    Args:
        runs: one per frame, of one domain and error at the start.
        recording: where the frames are from.
        extractor: the networks.
        truths: position of the frame -> what its estimate is compared with.
        renderer: of the camera that takes part, at its size.
        first: settings of the first frame; the others take `STEPS` steps of the same schedule.
    """
    scene, cameras = renderer.scene, [camera.name for camera in renderer.scene.cameras]
    found: list[Measurement] = []
    correction: dict[str, np.ndarray] = {}
    for run in sorted(runs, key=lambda run: run.frame):
        frame, truth = recording.frame(run.frame, run.domain, cameras), truths[run.frame]
        backgrounds = Backgrounds.of(recording, cameras, run.domain, required=True)
        measured = start_of(scene, frame, run, truth.measured_joints)
        start = {arm: values + correction.get(arm, 0.0) for arm, values in measured.items()}
        settings = DescentSolver.paper(STEPS) if found else first
        began = time.perf_counter()
        optimizer = FrameOptimizer(scene, frame, backgrounds, extractor, start=start, settings=settings, live=False)
        for _ in optimizer:
            pass
        seconds, best = time.perf_counter() - began, optimizer.best
        assert best is not None and optimizer.stop_reason is not None
        correction = {arm: values - measured[arm] for arm, values in best.joint_positions().items()}
        found.append(
            Measurement(
                run,
                truth.score(best.state, best.uncertainty, best.loss, renderer, seconds),
                (),
                (),
                "warm" if found else "cold",
                machine(extractor.device),
                truth.score(scene.state(measured), None, None, renderer, 0.0),
            )
        )
    return found
