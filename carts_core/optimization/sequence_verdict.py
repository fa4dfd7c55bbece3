"""How far the estimates of a sequence can be relied on, and what becomes of those that failed."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from ..model.scene import Scene
from ..recording import Frame
from ..recording.background import spread
from ..settings import FreeParameters
from .error_model import Gaussian
from .measurement import FrameSolver
from .sequence_estimate import FrameEstimate, Origin, Visit
from .variables import Variables
from .verdict import Verdict, assess
from .verdict_of_many import SequenceAssessment, assess_sequence

_LOOKED_AT = 3
"""Frames that tell whether base frames are off."""
_IN_VAIN = 5
"""Frames in a row that fail alone as well, after which no more are tried."""


def sequence_base_frame_gain(
    corrections: Mapping[int, Gaussian],
    solver: FrameSolver,
    opened: Callable[[int], tuple[Frame, Variables]],
    free: FreeParameters,
) -> float:
    """What free base frames would explain of the residual that is left: the median of a few frames [1].

    Args:
        corrections: position -> the correction of the measured values that was found; at least one.
        solver: that knows the images.
        opened: gives the frame at a position, and its unknowns.
        free: the unknowns, by kind.
    """
    indices = sorted(corrections)
    chosen = [indices[place] for place in spread(len(indices), min(_LOOKED_AT, len(indices)))]
    return statistics.median(
        [solver.base_frame_gain(*opened(index), corrections[index].mean, free) for index in chosen]
    )


def assessed_estimates(
    estimates: Mapping[int, FrameEstimate],
    corrections: Mapping[int, Gaussian],
    scene: Scene,
    solver: FrameSolver,
    opened: Callable[[int], tuple[Frame, Variables]],
    *,
    alone: bool,
) -> Iterator[FrameEstimate]:
    """Estimates with their assessments, and again those of frames that failed and were then solved alone.

    Args:
        estimates: position -> final estimate.
        corrections: position -> the correction of the measured values that it is.
        scene: of the sequence.
        solver: that knows the images.
        opened: gives the frame at a position, and its unknowns.
        alone: whether frames that failed are solved alone, too.
    """
    failed = []
    for index, estimate in estimates.items():
        began = time.perf_counter()
        frame, variables = opened(index)
        found = assess(solver.evidence(frame, variables, corrections[index].mean, estimate.loss))
        seconds = estimate.seconds + time.perf_counter() - began
        judged = replace(estimate.judged(found, scene), seconds=seconds)
        yield judged
        if found.verdict is Verdict.FAILED and not found.nothing_there:
            failed.append(judged)
    in_vain = 0
    for estimate in failed if alone else ():
        solved = _solved_alone(estimate, scene, solver, opened)
        in_vain = in_vain + 1 if solved.assessment is estimate.assessment else 0
        yield solved
        if in_vain == _IN_VAIN:
            return


def _solved_alone(
    estimate: FrameEstimate, scene: Scene, solver: FrameSolver, opened: Callable[[int], tuple[Frame, Variables]]
) -> FrameEstimate:
    """The estimate of a frame that is solved without the others; as it was, where that fails, too."""
    began = time.perf_counter()
    frame, variables = opened(estimate.index)
    found = solver.alone(frame, variables)
    seconds = time.perf_counter() - began
    verdict = found and found.assessment and found.assessment.verdict
    if found is None or found.uncertainty is None or verdict in (None, Verdict.FAILED):
        return replace(estimate, seconds=estimate.seconds + seconds)
    return estimate.solved_alone(scene, variables, found, seconds)


def assessed_sequence(
    estimates: Mapping[int, FrameEstimate], visits: Mapping[int, Visit], scene: Scene, prior: Gaussian, keyframes: bool
) -> tuple[SequenceAssessment, dict[int, FrameEstimate]]:
    """The verdict on the whole, and all estimates; where it has failed, frames that failed keep their measured values.

    Args:
        estimates: position -> assessed estimate; at least one.
        visits: what is kept of the frames.
        scene: of the sequence.
        prior: what is expected of a correction before any image.
        keyframes: whether a person set some; that counts more than the images, and all estimates stay.
    """
    found = {index: estimate.assessment for index, estimate in estimates.items() if estimate.assessment is not None}
    whole, kept = assess_sequence(list(found.values())), dict(estimates)
    if whole.verdict is Verdict.FAILED and not keyframes:
        for index, assessment in found.items():
            if assessment.verdict is Verdict.FAILED:
                measured = replace(visits[index], start=Origin.MEASURED).estimate(scene, index, prior, prior)
                kept[index] = replace(measured, assessment=assessment, seconds=estimates[index].seconds)
    return whole, kept
