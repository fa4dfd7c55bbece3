"""A sequence, corrected frame by frame, each frame knowing what the others found."""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..checkpoint import Checkpoint
from ..data import Frame
from ..data.background import spread
from ..errors import CartsError, SettingsError
from ..features.extractor import FeatureExtractor
from ..scene import Scene, SceneState
from ..settings import FreeParameters, OptimizerSettings, SequenceSettings
from .beginning import best_beginning
from .counterfactual import Backgrounds
from .error_model import ErrorModel, Gaussian, Information, combined, news, without
from .observability import Uncertainty
from .parameters import ParameterVector
from .recalled import RecallingEye
from .sight import Eye, Ignore, Sight

Start = Literal["warm", "cold", "keyframe", "carried"]
"""Where a frame's values come from: an optimization from the neighbour's correction or from the measured values, a
person, or the other frames alone, because the image contradicts them and is not to be believed."""

_SURPRISE = 9.0
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
    """Of the surface objective, where the frame was last looked at; high where the image does not fit."""
    start: Start
    iterations: int
    """Steps of the optimization, over all visits."""
    seconds: float
    """Time spent on the frame, reading included, over all visits [s]."""


@dataclass(frozen=True)
class _Visit:
    """What is kept of a frame that was seen, or asked for its opinion."""

    frame_id: str
    parameters: ParameterVector
    sight: Sight
    start: Start
    seconds: float


class SequenceOptimizer:
    """Corrects the frames of a sequence one after another.

    A few frames, evenly spread, are looked at alone first, and what suits all of them best is where the first frame
    starts. A later frame starts at the correction that the frames before it let expect, and is held there as firmly as
    they know it. After the last frame all corrections are smoothed, backwards; a frame whose image contradicts what
    came of it is visited again. Frames in `keyframes` stay exactly as given, and everything else follows them.

    Args:
        scene: arms and cameras.
        load: the frame at a position of the sequence; its `measured` is what is corrected.
        times: position of each frame to be corrected -> its time [s], or None where times are not known.
        extractor: the networks.
        settings: of a cold start; a warm one uses its fine stages. The loss is `surface`.
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
            the settings are of another solver or loss.
    """

    def __init__(
        self,
        scene: Scene,
        load: Callable[[int], Frame],
        times: Mapping[int, float | None],
        extractor: FeatureExtractor,
        *,
        settings: OptimizerSettings | None = None,
        model: SequenceSettings | None = None,
        free: FreeParameters | None = None,
        keyframes: Mapping[int, Mapping[str, ArrayLike]] | None = None,
        ignore: Ignore | None = None,
        backgrounds: Backgrounds | None = None,
        cameras: Sequence[str] | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self.settings, self.model = settings or OptimizerSettings(), model or SequenceSettings()
        self._scene, self._load, self._extractor = scene.with_cameras(cameras), load, extractor
        self._free = free or FreeParameters()
        if self.settings.chosen_solver != "gauss_newton":
            raise SettingsError(
                f"sequence mode was given the solver {self.settings.chosen_solver} and the loss {self.settings.loss}; "
                "it needs gauss_newton and surface. Leave them at their defaults, or optimize each frame alone."
            )
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
        self._eye = Eye(
            self._scene, extractor, self.settings, self.model.sight_noise, ignore or (lambda _: {}), backgrounds
        )
        if checkpoint is not None:
            self._eye = RecallingEye(self._eye, checkpoint)
        self._queue = list(self._gaps)
        self._told = self._shares()
        asked = {self._queue[place] for place in spread(len(self._queue), self.model.opinions)}
        asked.update([index for index in self._queue if index in self._keyframes][:1])
        # A frame that is alone, or that a person began with, needs no other opinion.
        alone = len(asked) == 1 or self._queue[0] in self._keyframes
        self._to_ask = [] if alone else [index for index in self._queue if index in asked]
        self._asked: dict[int, _Visit] = {}
        self._begin_at: np.ndarray | None = None
        _, parameters = self._open(self._queue[0])
        precision = parameters.prior_precision(
            self.model.constant_deg, self.settings.frame_prior_deg, self.settings.intrinsics_prior
        )
        self._errors = ErrorModel(self.model, precision.cpu().double().numpy() ** -0.5)
        self._fresh = self._errors.correction(self._errors.initial())
        self._visits: dict[int, _Visit] = {}
        self._beliefs: list[Gaussian] = []
        self._stale = False
        self._revisits: list[tuple[int, Gaussian]] | None = None
        self._estimates: dict[int, FrameEstimate] | None = None
        self.stop_reason: str | None = None

    @property
    def progress(self) -> tuple[int, int]:
        """Frames that were visited, and all frames; some are looked at before, and contradicted ones again after."""
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

        The first steps look at a few frames alone, and what they return is not among `estimates`. After them the
        estimate knows the frames visited before it; those in `estimates` know all others.
        """
        if self.stop_reason is not None:
            return None
        while self._to_ask:
            if (opinion := self._ask(self._to_ask.pop(0))) is not None:
                return opinion
        if self._queue:
            return self._visit(self._queue.pop(0))
        if self._revisits is None:
            self._revisits = self._contradicted()
        if self._revisits:
            return self._visit_again(*self._revisits.pop())
        self.stop_reason = "finished"
        return None

    def _ask(self, index: int) -> FrameEstimate | None:
        """What a frame alone says; None if it is not usable, which is told when its turn comes."""
        began = time.perf_counter()
        start: Start = "keyframe" if index in self._keyframes else "cold"
        try:
            frame, parameters = self._open(index)
            if start == "keyframe":
                sight = self._keyframe(frame, parameters, self._fresh)
            else:
                sight = self._eye.cold(frame, parameters, self._fresh, quick=True)
        except CartsError:
            return None
        visit = self._asked[index] = _Visit(frame.frame_id, parameters, sight, start, time.perf_counter() - began)
        return self._estimate(index, visit, combined(self._fresh, sight.information))

    def _visit(self, index: int) -> FrameEstimate:
        began = time.perf_counter()
        if self._asked and not self._visits:
            opinions = {asked: visit.sight.correction for asked, visit in self._asked.items()}
            self._begin_at = best_beginning(opinions, self._eye, self._open, self.model.cold_factor)
        frame, parameters = self._open(index)
        errors = self._errors
        expected = errors.initial()
        if self._beliefs:
            expected = errors.predicted(self._beliefs[-1], self._gaps[index])
        hoped = errors.correction(expected)
        if index in self._keyframes:
            start: Start = "keyframe"
            sight = self._keyframe(frame, parameters, hoped)
        else:
            start, sight, lost = self._look(frame, parameters, hoped)
            if self._beliefs and sight.information.surprise(hoped) > _SURPRISE:
                # Image and past contradict each other: where the image fits badly it is wrong, elsewhere the past.
                if lost:
                    start, sight = "carried", replace(sight, information=Information.nothing(len(parameters)))
                else:
                    self._gaps[index], expected = math.inf, errors.initial()
                    self._told, self._stale = self._shares(), True
        self._beliefs.append(errors.updated(expected, sight.information.scaled(self._told[index])))
        self._estimates = None
        seconds = time.perf_counter() - began
        if not self._visits:
            seconds += sum(visit.seconds for visit in self._asked.values())
            asked = sum(visit.sight.iterations for visit in self._asked.values())
            sight = replace(sight, iterations=sight.iterations + asked)
        visit = self._visits[index] = _Visit(frame.frame_id, parameters, sight, start, seconds)
        return self._estimate(index, visit, combined(errors.correction(expected), sight.information))

    def _look(self, frame: Frame, parameters: ParameterVector, expected: Gaussian) -> tuple[Start, Sight, bool]:
        """Look warm, and cold where there is no past or the loss is unusual; the last value says if in vain."""
        if not self._beliefs:
            return "cold", self._first_look(frame, parameters), False
        losses = [visit.sight.loss for visit in self._visits.values() if visit.start != "carried"]
        usual = self.model.cold_factor * statistics.median(losses or [math.inf])
        warm = self._eye.warm(frame, parameters, expected, expected.mean)
        if warm.loss <= usual:
            return "warm", warm, False
        cold = self._eye.cold(frame, parameters, self._fresh)
        best = min(warm, cold, key=lambda sight: sight.loss)
        best = replace(best, iterations=warm.iterations + cold.iterations)
        lost = best.loss > usual and best.loss * self.model.cold_factor > warm.loss
        return "warm" if best.loss == warm.loss else "cold", best, lost

    def _first_look(self, frame: Frame, parameters: ParameterVector) -> Sight:
        if self._begin_at is None:
            return self._eye.cold(frame, parameters, self._fresh)
        return self._eye.warm(frame, parameters, self._fresh, self._begin_at)

    def _keyframe(self, frame: Frame, parameters: ParameterVector, expected: Gaussian) -> Sight:
        given = self._keyframes[frame.index]
        correction = parameters.joint_offsets([given[arm.name] for arm in self._scene.arms])
        here = np.where(np.isfinite(correction), correction, expected.mean)
        seen = self._eye.at(frame, parameters, expected, here)
        return replace(seen, information=Information.exact(correction))

    def _open(self, index: int) -> tuple[Frame, ParameterVector]:
        frame = self._load(index)
        state = self._scene.state(frame.measured, self._extractor.device)
        return frame, ParameterVector(self._scene, state, self._free, self.settings.lever)

    def _shares(self) -> dict[int, float]:
        """Position -> share of a frame's information that it tells the others; a person's word counts whole."""
        told = news(list(self._gaps.values()), self.model.image_seconds)
        return {
            index: 1.0 if index in self._keyframes else share for index, share in zip(self._gaps, told, strict=True)
        }

    def _smoothed(self) -> dict[int, Gaussian]:
        """Corrections of all visited frames, each in the light of all of them, and of all that it shows itself."""
        if not self._visits:
            return {}
        gaps = [self._gaps[index] for index in self._visits]
        if self._stale:
            self._beliefs, belief = [], self._errors.initial()
            for (index, visit), gap in zip(self._visits.items(), gaps, strict=True):
                told = visit.sight.information.scaled(self._told[index])
                belief = self._errors.updated(self._errors.predicted(belief, gap), told)
                self._beliefs.append(belief)
            self._stale = False
        smoothed = zip(self._visits.items(), self._errors.smoothed(self._beliefs, gaps), strict=True)
        return {
            index: combined(belief, visit.sight.information.scaled(1.0 - self._told[index]))
            for (index, visit), belief in smoothed
        }

    def _contradicted(self) -> list[tuple[int, Gaussian]]:
        """Frames whose image does not fit what all frames together say, and what the others say of them."""
        chosen = []
        for index, smoothed in self._smoothed().items():
            visit = self._visits[index]
            certain = Gaussian(smoothed.mean, np.zeros_like(smoothed.covariance))
            if visit.start == "carried" or visit.sight.information.surprise(certain) > _SURPRISE:
                chosen.append((index, without(smoothed, visit.sight.information)))
        return chosen

    def _visit_again(self, index: int, expected: Gaussian) -> FrameEstimate:
        began = time.perf_counter()
        frame, parameters = self._open(index)
        earlier = self._visits[index]
        sight = self._eye.warm(frame, parameters, expected, expected.mean)
        start: Start = "warm"
        if sight.information.surprise(expected) > _SURPRISE:
            start, sight = "carried", replace(sight, information=Information.nothing(len(parameters)))
        sight = replace(sight, iterations=earlier.sight.iterations + sight.iterations)
        seconds = earlier.seconds + time.perf_counter() - began
        visit = self._visits[index] = _Visit(frame.frame_id, parameters, sight, start, seconds)
        self._stale, self._estimates = True, None
        return self._estimate(index, visit, combined(expected, sight.information))

    def _estimate(self, index: int, visit: _Visit, correction: Gaussian) -> FrameEstimate:
        offsets = torch.from_numpy(correction.mean).to(visit.parameters.lower)
        state = visit.parameters.state(visit.parameters.clamp(offsets)).detached()
        known = self._uncertainty(visit.parameters, correction)
        names = [arm.name for arm in self._scene.arms]
        deviation = [known.joint_std(arm.name, arm.robot.joint_names) for arm in self._scene.arms]
        joints = [values.cpu().double().numpy() for values in state.joint_positions]
        if index in self._keyframes:
            joints = [self._keyframes[index][name] for name in names]
            deviation = [np.zeros_like(values) for values in joints]
            given = self._scene.state(self._keyframes[index], self._extractor.device)
            state = replace(state, joint_positions=given.joint_positions)
        return FrameEstimate(
            index=index,
            frame_id=visit.frame_id,
            state=state,
            joint_positions={name: values.copy() for name, values in zip(names, joints, strict=True)},
            joint_std=dict(zip(names, deviation, strict=True)),
            uncertainty=known,
            loss=visit.sight.loss,
            start=visit.start,
            iterations=visit.sight.iterations,
            seconds=visit.seconds,
        )

    def _uncertainty(self, parameters: ParameterVector, correction: Gaussian) -> Uncertainty:
        scales = parameters.scales.cpu().double().numpy()
        std, expected = (np.sqrt(g.covariance.diagonal().clip(min=0.0)) * scales for g in (correction, self._fresh))
        return Uncertainty(tuple(parameters.names), tuple(std.tolist()), tuple(expected.tolist()))


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
