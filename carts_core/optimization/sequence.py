"""Optimizer of sequences, which couples frames through a temporal error model."""

import math
import statistics
import time
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..errors import CartsError, SettingsError
from ..model.scene import Scene
from ..networks.extractor import FeatureExtractor
from ..provenance import Checkpoint
from ..recording import Frame
from ..recording.background import evenly_spaced
from ..settings import FreeParameters, SequenceSettings, SolverSettings, surface_solver
from .kalman import ErrorModel, Gaussian, Information, Smoother, combined, remove_measurement
from .observation import Backgrounds
from .predictor import SurfacePredictor, predictor_of
from .sequence_frame import ColourTracker, FrameEstimate, Ignore, Measurement, Origin, SequenceFrameSolver, Visit
from .variables import Variables
from .verdict import Assessment, SequenceAssessment, Verdict, assess, assess_sequence


def visiting_gaps(times: Mapping[int, float | None], model: SequenceSettings) -> dict[int, float]:
    """Frame index -> time from the previously visited frame [s], in visiting order; 0 for the first frame.

    Args:
        times: frame index -> time [s], or None if unknown.
        model: direction, and the time between frames with unknown times.

    Raises:
        SettingsError: there are no frames, only some frames have times, or times do not increase.
    """
    if not times:
        raise SettingsError("no frame was given. Choose at least one frame.")
    without = [index for index, seconds in sorted(times.items()) if seconds is None]
    if 0 < len(without) < len(times):
        raise SettingsError(
            f"{len(without)} of {len(times)} frames have no time; the first is frame {without[0]}. Give times for all "
            "frames or for none."
        )
    known = {
        index: index * model.frame_seconds if seconds is None else seconds for index, seconds in sorted(times.items())
    }
    for (a, before), (b, after) in pairwise(known.items()):
        if not before < after:
            raise SettingsError(
                f"the time of frame {b}, {after:g} s, is not after that of frame {a}, {before:g} s. Times must "
                "increase; correct them in the sequence."
            )
    order = list(known) if model.direction == "forward" else list(reversed(known))
    return {index: abs(known[index] - known[previous]) for previous, index in pairwise([order[0], *order])}


def initial_correction(
    corrections: Mapping[int, Float[np.ndarray, " n"]],
    solver: SequenceFrameSolver,
    open_frame: Callable[[int], tuple[Frame, Variables]],
    allowance: float,
) -> Float[np.ndarray, " n"]:
    """Select, from the corrections [rad] of individually solved frames (by frame index), the correction with the lowest
    mean loss over these frames.

    Corrections whose loss in the first frame exceeds `allowance` times the minimum are excluded, since the error may
    jump between frames.
    """
    candidates = list(corrections.values())
    losses = np.array([solver.losses(*open_frame(index), candidates) for index in corrections])
    suits = losses[0] <= allowance * losses[0].min()
    return candidates[int(np.where(suits, losses.mean(0), np.inf).argmin())]


_LOOKED_AT = 3
"""Number of frames used to check base frames."""
_IN_VAIN = 5
"""Number of consecutive failures after which the single-frame solver is no longer tried."""

GivenPositions = Mapping[int, Mapping[str, ArrayLike]]
"""Frame index -> arm name -> one value per joint."""


class Keyframes:
    """Fixed joint positions of frames, exact or with a standard deviation.

    Args:
        positions: joint positions [rad, m].
        std: standard deviations [rad, m]; missing or NaN values count as 0.

    Raises:
        RobotError: an arm lacks joint positions, or has the wrong number.
    """

    def __init__(self, scene: Scene, positions: GivenPositions | None, std: GivenPositions | None) -> None:
        self._scene, self._positions, self._std = scene, _arrays(positions), _arrays(std)
        for given in self._positions.values():
            scene.state(given)

    def __contains__(self, index: object) -> bool:
        return index in self._positions

    def __iter__(self) -> Iterator[int]:
        return iter(self._positions)

    def __len__(self) -> int:
        return len(self._positions)

    @property
    def exact(self) -> set[int]:
        """Keyframes without a positive standard deviation; the others are estimates from images."""
        return {index for index in self if not any((std > 0).any() for std in self._deviations(index).values())}

    def correction(self, index: int, variables: Variables) -> tuple[Float[np.ndarray, " n"], Information]:
        """Correction of a frame's measured values, NaN for unknowns other than joints, and its information."""
        given, std = self._positions[index], self._deviations(index)
        correction = variables.joint_offsets([given[arm.name] for arm in self._scene.arms])
        farther = variables.joint_offsets([given[arm.name] + std[arm.name] for arm in self._scene.arms])
        return correction, Information.known(correction, farther - correction)

    def as_given(self, estimate: FrameEstimate) -> FrameEstimate:
        """Estimate with the joint positions and standard deviations of its keyframe; unchanged if the frame is not a
        keyframe."""
        if estimate.index not in self:
            return estimate
        given = self._positions[estimate.index]
        state = self._scene.state(given, estimate.state.joint_positions[0].device)
        return replace(
            estimate,
            state=replace(estimate.state, joint_positions=state.joint_positions),
            joint_positions={arm.name: given[arm.name].copy() for arm in self._scene.arms},
            joint_std=self._deviations(estimate.index),
        )

    def _deviations(self, index: int) -> dict[str, Float[np.ndarray, " dofs"]]:
        known, given = self._std.get(index, {}), self._positions[index]
        return {arm.name: np.nan_to_num(known.get(arm.name, 0.0 * given[arm.name])) for arm in self._scene.arms}


def _arrays(given: GivenPositions | None) -> dict[int, dict[str, np.ndarray]]:
    return {
        index: {name: np.asarray(values, np.float64) for name, values in positions.items()}
        for index, positions in (given or {}).items()
    }


class SequenceOptimizer:
    """Optimizer that corrects the frames of a sequence one after another.

    First, a few evenly spaced frames are solved individually; the first frame starts at the correction that fits all of
    these best. Each later frame starts at its predicted correction, with the covariance of the prediction as prior.
    After the last frame all corrections are smoothed backwards, and frames whose images contradict the result are
    optimized again. Finally, all estimates are assessed. Without keyframes, failed frames are solved individually if
    only joints are free, and if the sequence failed, frames that still fail return to their measured values. The joint
    positions of frames in `keyframes` are not changed. Frames without an image are predicted from the others and not
    assessed.

    Args:
        load: returns the frame at an index of the sequence, whose `measured` values are corrected.
        times: index of each frame to be corrected -> time [s], or None if unknown.
        networks: the networks, or a predictor of surface maps.
        settings: noise, weights, working size, and the stages by which failed frames are solved individually; all other
            stages are those of `model`.
        model: model of the measurement error, direction and stages.
        keyframes: frame index -> arm name -> manually set joint positions [rad, m].
        keyframe_std: frame index -> arm name -> standard deviations [rad, m] of keyframes that are accepted optimizer
            results, which share the errors of images close in time. Other keyframes, and NaN values, count as exact.
        ignore: frame index -> camera name -> pixels that show an occluder; none by default.
        backgrounds: mean backgrounds of the cameras, in which detections are false positives.
        cameras: names of the cameras to use, all by default.
        checkpoint: stores intermediate results, so that a stopped run can be resumed; see `sequence_checkpoint`.

    Raises:
        RobotError: a keyframe lacks an arm, or has the wrong number of joint positions.
        SettingsError: there are no frames, a keyframe is not among them, times do not increase, no parameter is free,
            or the settings belong to another solver.
    """

    def __init__(
        self,
        scene: Scene,
        load: Callable[[int], Frame],
        times: Mapping[int, float | None],
        networks: FeatureExtractor | SurfacePredictor,
        *,
        settings: SolverSettings | None = None,
        model: SequenceSettings | None = None,
        free: FreeParameters | None = None,
        keyframes: GivenPositions | None = None,
        keyframe_std: GivenPositions | None = None,
        ignore: Ignore | None = None,
        backgrounds: Backgrounds | None = None,
        cameras: Sequence[str] | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self.settings, self.model = surface_solver(settings, "sequence mode"), model or SequenceSettings()
        self._scene, self._load, self._predictor = scene.with_cameras(cameras), load, predictor_of(networks)
        self._free = free or FreeParameters()
        self._keyframes = Keyframes(self._scene, keyframes, keyframe_std)
        gaps = visiting_gaps(times, self.model)
        unknown = set(self._keyframes) - set(gaps)
        if unknown:
            raise SettingsError(
                f"keyframe {min(unknown)} is not among the frames. Add it to the frames, or remove the keyframe."
            )
        self._solver = SequenceFrameSolver(
            self._scene, self._predictor, self.settings, self.model, ignore or (lambda _: {}), backgrounds, checkpoint
        )
        self._tracker = ColourTracker(self.model)
        self._queue, self._frames = list(gaps), len(gaps)
        initial = {self._queue[place] for place in evenly_spaced(len(self._queue), self.model.initial_frames)}
        initial.update([index for index in self._queue if index in self._keyframes][:1])
        # No initial frames are needed for a single frame, or if the first frame is a keyframe.
        alone = len(initial) == 1 or self._queue[0] in self._keyframes
        self._initial_queue = [] if alone else [index for index in self._queue if index in initial]
        self._initial: dict[int, Visit] = {}
        self._initial_correction: np.ndarray | None = None
        _, variables = self._open(self._queue[0])
        expected = variables.expected(
            self.model.constant_deg, self.settings.frame_prior_deg, self.settings.intrinsics_prior
        )
        errors = ErrorModel(self.model, expected.cpu().double().numpy())
        self._prior = errors.correction(errors.initial())
        self._smoother = Smoother(errors, gaps, self.model.correlation_seconds, self._keyframes.exact)
        self._visits: dict[int, Visit] = {}
        self._revisits: list[tuple[int, Gaussian]] | None = None
        self._estimates: dict[int, FrameEstimate] | None = None
        self._judging: Iterator[FrameEstimate] | None = None
        self.stop_reason: str | None = None
        self.assessment: SequenceAssessment | None = None
        """Verdict on the sequence; None before the end."""

    @property
    def progress(self) -> tuple[int, int]:
        """Number of visited frames and of all frames, without initial and repeated visits."""
        return len(self._visits), self._frames

    @property
    def frames_per_second(self) -> float:
        """Visited frames per second [1/s]."""
        seconds = sum(visit.seconds for visit in self._visits.values())
        return len(self._visits) / seconds if seconds else 0.0

    @property
    def seconds_left(self) -> float:
        """Remaining time, estimated from the median time of a frame [s]."""
        visited, frames = self.progress
        return (frames - visited) * statistics.median([visit.seconds for visit in self._visits.values()] or [0.0])

    @property
    def estimates(self) -> dict[int, FrameEstimate]:
        """Frame index -> smoothed estimate of each visited frame, in visiting order."""
        if self._estimates is None:
            corrections = self._smoother.smoothed()
            certain = self._smoother.with_correlation(self.model.shared_seconds).smoothed()
            known = {index: Gaussian(found.mean, certain[index].covariance) for index, found in corrections.items()}
            self._estimates = {index: self._estimate(index, self._visits[index], known[index]) for index in known}
        return dict(self._estimates)

    @property
    def _seen(self) -> list[int]:
        """Visited frames with an image, in visiting order."""
        return [index for index, visit in self._visits.items() if not visit.blank]

    @property
    def _begun(self) -> bool:
        """Whether a keyframe or a frame whose image shows an arm has been visited."""
        return any(
            visit.measurement.information.any or index in self._keyframes for index, visit in self._visits.items()
        )

    def _is_blank(self, frame: Frame) -> bool:
        """Whether a frame has no image of any camera."""
        return {camera.name for camera in self._scene.cameras} <= set(frame.missing)

    def cancel(self) -> None:
        """Stop the optimization; `estimates` are kept."""
        self.stop_reason = self.stop_reason or "cancelled"

    def __iter__(self) -> Iterator[FrameEstimate]:
        """Step until all frames are finished."""
        return iter(self.step, None)

    def step(self) -> FrameEstimate | None:
        """Visit the next frame; None once all frames are finished.

        The first steps solve a few frames individually; their results are not in `estimates`. Later steps return the
        filtered estimate, based on the frames visited so far; `estimates` are smoothed over all visited frames. The
        last steps visit some frames again and assess all frames.
        """
        if self.stop_reason is not None:
            return None
        while self._initial_queue:
            if (alone := self._solve_initial(self._initial_queue.pop(0))) is not None:
                return alone
        if self._queue:
            return self._visit(self._queue.pop(0))
        if self._revisits is None:
            self._revisits = self._contradicted()
        if self._revisits:
            return self._visit_again(*self._revisits.pop())
        if self._judging is None:
            self._judging = self._assessed()
        if (judged := next(self._judging, None)) is not None:
            self._estimates = self.estimates | {judged.index: judged}
            return judged
        self._assess_whole()
        self.stop_reason = "finished"
        return None

    def base_frame_gain(self) -> float | None:
        """Like `FrameOptimizer.base_frame_gain`, as median over a few frames; None before the end, or if base frames
        are free."""
        if self.assessment is None or self._free.base_frames:
            return None
        corrections = self._smoother.smoothed()
        indices = sorted(self._seen)
        chosen = [indices[place] for place in evenly_spaced(len(indices), min(_LOOKED_AT, len(indices)))]
        return statistics.median(
            [self._solver.base_frame_gain(*self._open(i), corrections[i].mean, self._free) for i in chosen]
        )

    def _assessed(self) -> Iterator[FrameEstimate]:
        """Assess all estimates, then solve failed frames individually if there are no keyframes and only joints are
        free; yield each new estimate."""
        failed, corrections = [], self._smoother.smoothed()
        anchors = self._anchors()
        individually = set(anchors)
        known: dict[int, Assessment] = {}
        # The other frames come last, since their verdicts depend on these frames.
        for index in sorted(self._seen, key=lambda index: index not in individually):
            began, estimate = time.perf_counter(), self.estimates[index]
            found = None if index in individually else self._between_good_frames(index, anchors, known)
            if found is None:
                frame, variables = self._open(index)
                found = assess(self._solver.evidence(frame, variables, corrections[index].mean, estimate.loss))
            known[index] = found
            seconds = estimate.seconds + time.perf_counter() - began
            judged = replace(estimate.judged(found, self._scene), seconds=seconds)
            yield judged
            if found.verdict is Verdict.FAILED and not found.nothing_there:
                failed.append(judged)
        in_vain = 0
        for estimate in failed if not self._keyframes and self._free.joints_only else ():
            began = time.perf_counter()
            frame, variables = self._open(estimate.index)
            alone = self._solver.run_frame_stages(frame, variables)
            seconds = time.perf_counter() - began
            verdict = alone and alone.assessment and alone.assessment.verdict
            if alone is None or alone.uncertainty is None or verdict in (None, Verdict.FAILED):
                in_vain += 1
                yield replace(estimate, seconds=estimate.seconds + seconds)
            else:
                in_vain = 0
                yield estimate.with_single_frame_fit(self._scene, variables, alone, seconds)
            if in_vain == _IN_VAIN:
                return

    def _anchors(self) -> list[int]:
        """Frames that get their own verdict: those that needed the network, and a few routine ones."""
        chosen, since = [], self.model.assess_every
        for index in sorted(self._seen):
            visit, since = self._visits[index], since + 1
            if not (visit.measurement.by_colours or (visit.routine and since < self.model.assess_every)):
                chosen.append(index)
                since = 0
        return chosen

    def _between_good_frames(
        self, index: int, anchors: Sequence[int], known: Mapping[int, Assessment]
    ) -> Assessment | None:
        """The less certain one of the verdicts before and after a frame, if both are good; None otherwise."""
        place = bisect(anchors, index)
        beside = [known[other] for other in anchors[max(place - 1, 0) : place + 1]]
        if not beside or any(one.verdict is not Verdict.GOOD for one in beside):
            return None
        return max(beside, key=lambda one: one.probability)

    def _assess_whole(self) -> None:
        """Assess the sequence; if it failed and there are no keyframes, failed frames and frames without an image
        return to their measured values."""
        kept = self.estimates
        found = [estimate.assessment for estimate in kept.values() if estimate.assessment is not None]
        if not found:
            return
        self.assessment = assess_sequence(found)
        if self.assessment.verdict is Verdict.FAILED and not self._keyframes:
            for index, estimate in kept.items():
                if estimate.assessment is None or estimate.assessment.verdict is Verdict.FAILED:
                    visit = replace(self._visits[index], start=Origin.MEASURED)
                    measured = visit.estimate(self._scene, index, self._prior, self._prior)
                    kept[index] = replace(measured, assessment=estimate.assessment, seconds=estimate.seconds)
        self._estimates = kept

    def _solve_initial(self, index: int) -> FrameEstimate | None:
        """Solve an initial frame; None if the frame cannot be used, which is reported when it is visited."""
        began = time.perf_counter()
        try:
            frame, variables = self._open(index)
            if index in self._keyframes:
                start, measurement = Origin.KEYFRAME, self._keyframe(frame, variables, self._prior)
            elif self._is_blank(frame):
                return None
            else:
                start, measurement = Origin.COLD, self._solver.cold(frame, variables, self._prior, quick=True)
        except CartsError:
            return None
        visit = Visit(frame.frame_id, variables, measurement, start, time.perf_counter() - began)
        self._initial[index] = visit
        return self._estimate(index, visit, combined(self._prior, measurement.information))

    def _visit(self, index: int) -> FrameEstimate:
        began = time.perf_counter()
        if self._initial and not self._visits:
            corrections = {alone: visit.measurement.correction for alone, visit in self._initial.items()}
            self._initial_correction = initial_correction(corrections, self._solver, self._open, self.model.cold_factor)
        frame, variables = self._open(index)
        expected, routine, blank = self._smoother.expected(index), False, self._is_blank(frame)
        if index in self._keyframes:
            start, measurement = Origin.KEYFRAME, self._keyframe(frame, variables, expected)
        elif blank:
            nothing = Information.nothing(len(variables))
            start, measurement = Origin.CARRIED, Measurement(expected.mean, nothing, loss=0.0, iterations=0)
        elif (found := self._without_network(frame, variables, expected)) is not None:
            start, measurement = Origin.WARM, found
        else:
            start, measurement, lost = self._measure(frame, variables, expected)
            contradicts = self._begun and measurement.information.contradicts(expected, variables.groups)
            fits = measurement.information.any and not (lost or contradicts)
            usual = fits and measurement.loss <= self._unusual_loss()
            routine = usual and start is Origin.WARM and self._tracker.ready
            self._tracker.learn(self._solver, frame, variables, measurement, usual)
            if contradicts:
                # If the image fits badly, it is ignored; otherwise the prediction is wrong, and the filter restarts.
                if lost:
                    start, measurement = Origin.CARRIED, measurement.left_out()
                else:
                    self._smoother.restart(index)
        seconds = time.perf_counter() - began
        if not self._visits:
            seconds += sum(visit.seconds for visit in self._initial.values())
            before = sum(visit.measurement.iterations for visit in self._initial.values())
            measurement = replace(measurement, iterations=measurement.iterations + before)
        visit = self._visits[index] = Visit(frame.frame_id, variables, measurement, start, seconds, routine, blank)
        self._estimates = None
        return self._estimate(index, visit, self._smoother.add(index, measurement.information))

    def _without_network(self, frame: Frame, variables: Variables, expected: Gaussian) -> Measurement | None:
        """Measurement without the network; None if the network is needed, as where the error jumps."""
        alone = self._initial.get(frame.index)
        jumps = alone is not None and alone.measurement.information.contradicts(expected, variables.groups)
        if jumps or not self._begun:
            return None
        return self._tracker.measured(self._solver, frame, variables, expected)

    def _measure(self, frame: Frame, variables: Variables, expected: Gaussian) -> tuple[Origin, Measurement, bool]:
        """Measure a frame from a warm start, or from a cold start for the first frame or after an unusual loss; the
        last value is whether recovery failed."""
        alone = self._initial.get(frame.index)
        usual = self._unusual_loss()
        if alone is not None:
            # Where the error jumps, the frame fits much worse than it did individually.
            usual = min(usual, self.model.cold_factor * alone.measurement.loss)
        if not self._begun:
            if self._initial_correction is None:
                return Origin.COLD, self._solver.cold(frame, variables, self._prior), False
            first = self._solver.warm(frame, variables, self._prior, self._initial_correction)
            return Origin.COLD, first if alone is None or first.loss <= usual else alone.measurement, False
        warm = self._solver.warm(frame, variables, expected, expected.mean)
        if warm.loss > usual:
            wide = self._solver.warm(frame, variables, expected, expected.mean, wide=True)
            warm = replace(min(warm, wide, key=lambda found: found.loss), iterations=warm.iterations + wide.iterations)
        if warm.loss <= usual or not (warm.information.any or self._is_in_view(frame, variables, expected)):
            return Origin.WARM, warm, False
        cold = self._solver.cold(frame, variables, self._prior) if alone is None else alone.measurement
        best = min(warm, cold, key=lambda measurement: measurement.loss)
        best = replace(best, iterations=warm.iterations + cold.iterations)
        lost = best.loss > usual and best.loss * self.model.cold_factor > warm.loss
        return Origin.WARM if best.loss == warm.loss else Origin.COLD, best, lost

    def _is_in_view(self, frame: Frame, variables: Variables, expected: Gaussian) -> bool:
        """Whether an arm is in view at the measured values."""
        return self._solver.at(frame, variables, expected, np.zeros(len(variables))).information.any

    def _unusual_loss(self) -> float:
        """Loss above which a frame gets a cold start; frames without arms in view are not counted."""
        visits = [self._visits[index] for index in self._seen]
        losses = [visit.measurement.loss for visit in visits if visit.measurement.information.any]
        return self.model.cold_factor * statistics.median(losses or [math.inf])

    def _keyframe(self, frame: Frame, variables: Variables, expected: Gaussian) -> Measurement:
        correction, known = self._keyframes.correction(frame.index, variables)
        here = np.where(np.isfinite(correction), correction, expected.mean)
        seen = self._solver.at(frame, variables, expected, here)
        return replace(seen, information=known)

    def _open(self, index: int) -> tuple[Frame, Variables]:
        frame = self._load(index)
        state = self._scene.state(frame.measured, self._predictor.device, frame.mounts)
        return frame, Variables(self._scene, state, self._free, self.settings.length_scale)

    def _contradicted(self) -> list[tuple[int, Gaussian]]:
        """Frames with `Origin.CARRIED` or a measurement that contradicts the smoothed correction, with the prediction
        from the other frames; neither keyframes nor frames without an image."""
        chosen, corrections = [], self._smoother.smoothed()
        for index in self._seen:
            if index in self._keyframes:
                continue
            visit, smoothed = self._visits[index], corrections[index]
            certain = Gaussian(smoothed.mean, np.zeros_like(smoothed.covariance))
            if visit.start is Origin.CARRIED or visit.measurement.information.contradicts(
                certain, visit.variables.groups
            ):
                chosen.append((index, remove_measurement(smoothed, visit.measurement.information)))
        return chosen

    def _visit_again(self, index: int, expected: Gaussian) -> FrameEstimate:
        began = time.perf_counter()
        frame, variables = self._open(index)
        earlier = self._visits[index]
        measurement = self._solver.warm(frame, variables, expected, expected.mean)
        start = Origin.WARM
        if measurement.information.contradicts(expected, variables.groups):
            start, measurement = Origin.CARRIED, measurement.left_out()
        measurement = replace(measurement, iterations=earlier.measurement.iterations + measurement.iterations)
        seconds = earlier.seconds + time.perf_counter() - began
        visit = self._visits[index] = Visit(frame.frame_id, variables, measurement, start, seconds)
        self._smoother.replace(index, measurement.information)
        self._estimates = None
        return self._estimate(index, visit, combined(expected, measurement.information))

    def _estimate(self, index: int, visit: Visit, correction: Gaussian) -> FrameEstimate:
        return self._keyframes.as_given(visit.estimate(self._scene, index, correction, self._prior))
