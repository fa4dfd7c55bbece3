"""A sequence, corrected frame by frame, each frame knowing what the others found."""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checkpoint import Checkpoint
from ..errors import CartsError, SettingsError
from ..model.scene import Scene, SceneState
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from ..recording.background import spread
from ..settings import FreeParameters, SequenceSettings, SolverSettings, SurfaceSolver
from .counterfactual import Backgrounds
from .error_model import ErrorModel, Gaussian, Information, combined, information_shares, remove_measurement
from .initialization import initial_correction
from .measurement import FrameSolver, Ignore, Measurement
from .observability import Uncertainty
from .predictor import SurfacePredictor, predictor_of
from .resumable import ResumableFrameSolver
from .variables import Variables


class Origin(StrEnum):
    """Where a frame's values come from."""

    WARM = "warm"
    """An optimization from the neighbour's correction."""
    COLD = "cold"
    """An optimization from the measured values."""
    KEYFRAME = "keyframe"
    """A person."""
    CARRIED = "carried"
    """The other frames alone: the image contradicts them and is left out."""


_CONTRADICTS = 9.0
"""A correction three deviations off what was expected, on average, contradicts it."""


@dataclass(frozen=True)
class FrameEstimate:
    """One frame of a sequence, in the light of the others that were seen."""

    index: int
    frame_id: str
    state: SceneState
    joint_positions: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> [rad, m]."""
    joint_std: dict[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; 0 at a keyframe, NaN where a joint is not free."""
    uncertainty: Uncertainty
    """Of every unknown, with what was expected of it before any image."""
    loss: float
    """Of the surface factor, when the frame was last solved; high where the image does not fit."""
    start: Origin
    iterations: int
    """Steps of the optimization, over all visits."""
    seconds: float
    """Time spent on the frame, reading included, over all visits [s]."""


@dataclass(frozen=True)
class _Visit:
    """What is kept of a frame that was solved."""

    frame_id: str
    variables: Variables
    measurement: Measurement
    start: Origin
    seconds: float


class SequenceOptimizer:
    """Corrects the frames of a sequence one after another.

    A few frames, evenly spread, are solved alone first, and what suits all of them best is where the first frame
    starts. A later frame starts at the correction that the frames before it let expect, and is held there as firmly as
    they know it. After the last frame all corrections are smoothed, backwards; a frame whose image contradicts what
    came of it is visited again. Frames in `keyframes` stay exactly as given, and everything else follows them.

    Args:
        scene: arms and cameras.
        load: the frame at a position of the sequence; its `measured` is what is corrected.
        times: position of each frame to be corrected -> its time [s], or None where times are not known.
        networks: the networks, or another predictor of surface maps.
        settings: noise, weights and working size; the stages are those of `model`.
        model: of the measurement error, and the direction.
        free: what is unknown.
        keyframes: position -> arm name -> joint positions [rad, m] that a person set.
        ignore: position -> camera name -> pixels that show an occluder; none by default.
        backgrounds: of the cameras; what looks like an arm in them is taken for none.
        cameras: names of the cameras that take part, all by default.
        checkpoint: keeps what was found on disk, for a run that goes on after a stop; see `sequence_checkpoint`.

    Raises:
        RobotError: a keyframe lacks an arm, or has the wrong number of joint positions.
        SettingsError: there are no frames, a keyframe is none of them, times do not increase, nothing is free, or
            the settings are those of another solver.
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
        keyframes: Mapping[int, Mapping[str, ArrayLike]] | None = None,
        ignore: Ignore | None = None,
        backgrounds: Backgrounds | None = None,
        cameras: Sequence[str] | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self.settings, self.model = surface_solver(settings, "sequence mode"), model or SequenceSettings()
        self._scene, self._load, self._predictor = scene.with_cameras(cameras), load, predictor_of(networks)
        self._free = free or FreeParameters()
        self._keyframes = {
            index: {name: np.asarray(values, np.float64) for name, values in positions.items()}
            for index, positions in (keyframes or {}).items()
        }
        for positions in self._keyframes.values():
            self._scene.state(positions)
        self._gaps = _gaps(times, self.model)
        strangers = set(self._keyframes) - set(self._gaps)
        if strangers:
            raise SettingsError(f"keyframe {min(strangers)} is not among the frames. Choose it too, or leave it out.")
        self._solver = FrameSolver(
            self._scene, self._predictor, self.settings, self.model, ignore or (lambda _: {}), backgrounds
        )
        if checkpoint is not None:
            self._solver = ResumableFrameSolver(self._solver, checkpoint)
        self._queue = list(self._gaps)
        self._shares = self._information_shares()
        initial = {self._queue[place] for place in spread(len(self._queue), self.model.initial_frames)}
        initial.update([index for index in self._queue if index in self._keyframes][:1])
        # A frame that is alone, or that a person began with, needs no others.
        alone = len(initial) == 1 or self._queue[0] in self._keyframes
        self._initial_queue = [] if alone else [index for index in self._queue if index in initial]
        self._initial: dict[int, _Visit] = {}
        self._initial_correction: np.ndarray | None = None
        _, variables = self._open(self._queue[0])
        expected = variables.expected(
            self.model.constant_deg, self.settings.frame_prior_deg, self.settings.intrinsics_prior
        )
        self._errors = ErrorModel(self.model, expected.cpu().double().numpy())
        self._fresh = self._errors.correction(self._errors.initial())
        self._visits: dict[int, _Visit] = {}
        self._filtered: list[Gaussian] = []
        self._stale = False
        self._revisits: list[tuple[int, Gaussian]] | None = None
        self._estimates: dict[int, FrameEstimate] | None = None
        self.stop_reason: str | None = None

    @property
    def progress(self) -> tuple[int, int]:
        """Frames that were visited, and all frames; some are solved before, and contradicted ones again after."""
        return len(self._visits), len(self._gaps)

    @property
    def frames_per_second(self) -> float:
        """Frames that were visited per second spent on them [1/s]."""
        seconds = sum(visit.seconds for visit in self._visits.values())
        return len(self._visits) / seconds if seconds else 0.0

    @property
    def seconds_left(self) -> float:
        """How long the frames that are left will take, if each takes as long as most did so far [s]."""
        visited, frames = self.progress
        return (frames - visited) * statistics.median([visit.seconds for visit in self._visits.values()] or [0.0])

    @property
    def estimates(self) -> dict[int, FrameEstimate]:
        """Position -> estimate of every frame visited so far, in the light of all of them; ordered as visited."""
        if self._estimates is None:
            corrections = self._smoothed()
            self._estimates = {
                index: self._estimate(index, self._visits[index], corrections[index]) for index in corrections
            }
        return dict(self._estimates)

    def cancel(self) -> None:
        """Stop; what was reached stays in `estimates`."""
        self.stop_reason = self.stop_reason or "cancelled"

    def __iter__(self) -> Iterator[FrameEstimate]:
        """Step until all is done."""
        while (estimate := self.step()) is not None:
            yield estimate

    def step(self) -> FrameEstimate | None:
        """Visit the next frame; None once all is done.

        The first steps solve a few frames alone, and what they return is not among `estimates`. After them the
        estimate knows the frames visited before it; those in `estimates` know all others.
        """
        if self.stop_reason is not None:
            return None
        while self._initial_queue:
            if (alone := self._solve_alone(self._initial_queue.pop(0))) is not None:
                return alone
        if self._queue:
            return self._visit(self._queue.pop(0))
        if self._revisits is None:
            self._revisits = self._contradicted()
        if self._revisits:
            return self._visit_again(*self._revisits.pop())
        self.stop_reason = "finished"
        return None

    def _solve_alone(self, index: int) -> FrameEstimate | None:
        """What a frame alone measures; None if it is not usable, which is reported when its turn comes."""
        began = time.perf_counter()
        start = Origin.KEYFRAME if index in self._keyframes else Origin.COLD
        try:
            frame, variables = self._open(index)
            if start is Origin.KEYFRAME:
                measurement = self._keyframe(frame, variables, self._fresh)
            else:
                measurement = self._solver.cold(frame, variables, self._fresh, quick=True)
        except CartsError:
            return None
        visit = _Visit(frame.frame_id, variables, measurement, start, time.perf_counter() - began)
        self._initial[index] = visit
        return self._estimate(index, visit, combined(self._fresh, measurement.information))

    def _visit(self, index: int) -> FrameEstimate:
        began = time.perf_counter()
        if self._initial and not self._visits:
            corrections = {alone: visit.measurement.correction for alone, visit in self._initial.items()}
            self._initial_correction = initial_correction(corrections, self._solver, self._open, self.model.cold_factor)
        frame, variables = self._open(index)
        errors = self._errors
        expected = errors.initial()
        if self._filtered:
            expected = errors.predicted(self._filtered[-1], self._gaps[index])
        predicted = errors.correction(expected)
        if index in self._keyframes:
            start = Origin.KEYFRAME
            measurement = self._keyframe(frame, variables, predicted)
        else:
            start, measurement, lost = self._measure(frame, variables, predicted)
            if self._filtered and measurement.information.mahalanobis(predicted) > _CONTRADICTS:
                # Image and past contradict each other: where the image fits badly it is wrong, elsewhere the past.
                if lost:
                    start, measurement = Origin.CARRIED, _left_out(measurement)
                else:
                    self._gaps[index], expected = math.inf, errors.initial()
                    self._shares, self._stale = self._information_shares(), True
        self._filtered.append(errors.updated(expected, measurement.information.scaled(self._shares[index])))
        self._estimates = None
        seconds = time.perf_counter() - began
        if not self._visits:
            seconds += sum(visit.seconds for visit in self._initial.values())
            before = sum(visit.measurement.iterations for visit in self._initial.values())
            measurement = replace(measurement, iterations=measurement.iterations + before)
        visit = self._visits[index] = _Visit(frame.frame_id, variables, measurement, start, seconds)
        return self._estimate(index, visit, combined(errors.correction(expected), measurement.information))

    def _measure(self, frame: Frame, variables: Variables, expected: Gaussian) -> tuple[Origin, Measurement, bool]:
        """Start warm, and cold where there is no past or the loss is unusual; the last value says if in vain."""
        if not self._filtered:
            return Origin.COLD, self._first_measurement(frame, variables), False
        losses = [visit.measurement.loss for visit in self._visits.values() if visit.start is not Origin.CARRIED]
        usual = self.model.cold_factor * statistics.median(losses or [math.inf])
        warm = self._solver.warm(frame, variables, expected, expected.mean)
        if warm.loss <= usual:
            return Origin.WARM, warm, False
        cold = self._solver.cold(frame, variables, self._fresh)
        best = min(warm, cold, key=lambda measurement: measurement.loss)
        best = replace(best, iterations=warm.iterations + cold.iterations)
        lost = best.loss > usual and best.loss * self.model.cold_factor > warm.loss
        return Origin.WARM if best.loss == warm.loss else Origin.COLD, best, lost

    def _first_measurement(self, frame: Frame, variables: Variables) -> Measurement:
        if self._initial_correction is None:
            return self._solver.cold(frame, variables, self._fresh)
        return self._solver.warm(frame, variables, self._fresh, self._initial_correction)

    def _keyframe(self, frame: Frame, variables: Variables, expected: Gaussian) -> Measurement:
        given = self._keyframes[frame.index]
        correction = variables.joint_offsets([given[arm.name] for arm in self._scene.arms])
        here = np.where(np.isfinite(correction), correction, expected.mean)
        seen = self._solver.at(frame, variables, expected, here)
        return replace(seen, information=Information.exact(correction))

    def _open(self, index: int) -> tuple[Frame, Variables]:
        frame = self._load(index)
        state = self._scene.state(frame.measured, self._predictor.device)
        return frame, Variables(self._scene, state, self._free, self.settings.length_scale)

    def _information_shares(self) -> dict[int, float]:
        """Position -> share of a frame's information that counts for the others; that of a keyframe counts whole."""
        shares = information_shares(list(self._gaps.values()), self.model.correlation_seconds)
        return {
            index: 1.0 if index in self._keyframes else share for index, share in zip(self._gaps, shares, strict=True)
        }

    def _smoothed(self) -> dict[int, Gaussian]:
        """Corrections of all visited frames, each in the light of all of them, and of all that it shows itself."""
        if not self._visits:
            return {}
        gaps = [self._gaps[index] for index in self._visits]
        if self._stale:
            self._filtered, state = [], self._errors.initial()
            for (index, visit), gap in zip(self._visits.items(), gaps, strict=True):
                shared = visit.measurement.information.scaled(self._shares[index])
                state = self._errors.updated(self._errors.predicted(state, gap), shared)
                self._filtered.append(state)
            self._stale = False
        smoothed = zip(self._visits.items(), self._errors.smoothed(self._filtered, gaps), strict=True)
        return {
            index: combined(state, visit.measurement.information.scaled(1.0 - self._shares[index]))
            for (index, visit), state in smoothed
        }

    def _contradicted(self) -> list[tuple[int, Gaussian]]:
        """Frames whose image does not fit what all frames together say, and what the others say of them."""
        chosen = []
        for index, smoothed in self._smoothed().items():
            visit = self._visits[index]
            certain = Gaussian(smoothed.mean, np.zeros_like(smoothed.covariance))
            distance = visit.measurement.information.mahalanobis(certain)
            if visit.start is Origin.CARRIED or distance > _CONTRADICTS:
                chosen.append((index, remove_measurement(smoothed, visit.measurement.information)))
        return chosen

    def _visit_again(self, index: int, expected: Gaussian) -> FrameEstimate:
        began = time.perf_counter()
        frame, variables = self._open(index)
        earlier = self._visits[index]
        measurement = self._solver.warm(frame, variables, expected, expected.mean)
        start = Origin.WARM
        if measurement.information.mahalanobis(expected) > _CONTRADICTS:
            start, measurement = Origin.CARRIED, _left_out(measurement)
        measurement = replace(measurement, iterations=earlier.measurement.iterations + measurement.iterations)
        seconds = earlier.seconds + time.perf_counter() - began
        visit = self._visits[index] = _Visit(frame.frame_id, variables, measurement, start, seconds)
        self._stale, self._estimates = True, None
        return self._estimate(index, visit, combined(expected, measurement.information))

    def _estimate(self, index: int, visit: _Visit, correction: Gaussian) -> FrameEstimate:
        offsets = torch.from_numpy(correction.mean).to(visit.variables.lower)
        state = visit.variables.state(visit.variables.clamp(offsets)).detached()
        known = self._uncertainty(visit.variables, correction)
        names = [arm.name for arm in self._scene.arms]
        deviation = [known.joint_std(arm.name, arm.robot.joint_names) for arm in self._scene.arms]
        joints = [values.cpu().double().numpy() for values in state.joint_positions]
        if index in self._keyframes:
            joints = [self._keyframes[index][name] for name in names]
            deviation = [np.zeros_like(values) for values in joints]
            given = self._scene.state(self._keyframes[index], self._predictor.device)
            state = replace(state, joint_positions=given.joint_positions)
        return FrameEstimate(
            index=index,
            frame_id=visit.frame_id,
            state=state,
            joint_positions={name: values.copy() for name, values in zip(names, joints, strict=True)},
            joint_std=dict(zip(names, deviation, strict=True)),
            uncertainty=known,
            loss=visit.measurement.loss,
            start=visit.start,
            iterations=visit.measurement.iterations,
            seconds=visit.seconds,
        )

    def _uncertainty(self, variables: Variables, correction: Gaussian) -> Uncertainty:
        scales = variables.scales.cpu().double().numpy()
        std, expected = (np.sqrt(g.covariance.diagonal().clip(min=0.0)) * scales for g in (correction, self._fresh))
        return Uncertainty(tuple(variables.names), tuple(std.tolist()), tuple(expected.tolist()))


def _left_out(measurement: Measurement) -> Measurement:
    """Without the information of its image."""
    return replace(measurement, information=Information.nothing(len(measurement.correction)))


def surface_solver(settings: SolverSettings | None, what: str) -> SurfaceSolver:
    """The settings, or the default ones.

    Raises:
        SettingsError: they are those of another solver.
    """
    if settings is None or isinstance(settings, SurfaceSolver):
        return settings or SurfaceSolver()
    raise SettingsError(
        f"{what} was given a solver for the loss {settings.loss.value!r}; it needs the solver `surface`. "
        "Leave it at its default, or optimize each frame alone."
    )


def _gaps(times: Mapping[int, float | None], model: SequenceSettings) -> dict[int, float]:
    """Position -> seconds from the frame visited before it, in the order of the visits."""
    if not times:
        raise SettingsError("there are no frames to correct. Choose at least one.")
    known = {
        index: index * model.frame_seconds if seconds is None else seconds for index, seconds in sorted(times.items())
    }
    for (a, before), (b, after) in pairwise(known.items()):
        if not before < after:
            raise SettingsError(
                f"frame {b} was taken at {after:g} s and frame {a} at {before:g} s. Times must increase; correct them "
                "in the sequence."
            )
    order = list(known) if model.direction == "forward" else list(reversed(known))
    return {index: abs(known[index] - known[previous]) for previous, index in pairwise([order[0], *order])}
