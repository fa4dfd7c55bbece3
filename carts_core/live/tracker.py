"""Tracker of arms in a stream, and its estimates."""

import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import StrEnum

import cv2
import numpy as np
from jaxtyping import Float

from ..model.scene import Scene, SceneState
from ..networks.extractor import FeatureExtractor
from ..optimization.kalman import ErrorModel, Gaussian, Information, combined
from ..optimization.observation import Backgrounds
from ..optimization.predictor import SurfacePredictor, predictor_of
from ..optimization.regions import ColourModel
from ..optimization.sequence_frame import ColourTracker, Measurement, Origin, SequenceFrameSolver, Visit
from ..optimization.variables import Variables
from ..optimization.verdict import arm_is_elsewhere
from ..recording import Frame
from ..settings import FreeParameters, SequenceSettings, SurfaceSolver
from ..settings.live import LiveSettings
from ..settings.stages import Stage
from .messages import mounts_of


class LiveVerdict(StrEnum):
    """Reliability of a live estimate."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    """The fit is bad and the estimate is predicted from earlier frames; or an arm out of view is detected elsewhere."""
    LOST = "lost"
    """The arms are lost; the estimate consists of the measured values with the last known correction."""


class Effort(StrEnum):
    """Computational effort for a frame."""

    SMALL = "small"
    FULL = "full"
    SEARCH = "search"


@dataclass(frozen=True)
class LiveEstimate:
    """Estimate for one frame, given the previous frames."""

    frame_id: str
    time: float
    """Timestamp [s]."""
    verdict: LiveVerdict
    effort: Effort
    loss: float
    """Loss of the surface factor [1]."""
    state: SceneState
    joint_positions: Mapping[str, Float[np.ndarray, " dofs"]]
    """Arm name -> estimated joint positions [rad, m]."""
    joint_std: Mapping[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; NaN where a joint is not free."""
    seconds: float
    """Computation time [s]."""


CHANGED = 0.5
"""Change of thumbnails above which the scene is considered different; equivalent to a correlation of one half [1]."""
_LOOK_EVERY = 8
"""Default number of frames from one evaluation of the network to the next while colours identify the arms [1]."""
_SIZE = (32, 24)
"""Width and height of thumbnails [px]."""

Picture = Float[np.ndarray, "cameras pixels"]


def small_picture(frame: Frame) -> Picture:
    """Zero-mean grey thumbnails of the images."""
    small = [cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA) for image in frame.images.values()]
    pixels = np.stack([image.reshape(_SIZE[0] * _SIZE[1], -1).mean(axis=1) for image in small]).astype(float)
    return pixels - pixels.mean(axis=1, keepdims=True)


def change(before: Picture, now: Picture) -> float:
    """Maximum change of a thumbnail over the cameras [1]; 0.7 for uncorrelated thumbnails."""
    sizes = np.linalg.norm(before, axis=1) + np.linalg.norm(now, axis=1)
    return float((np.linalg.norm(now - before, axis=1) / (sizes + np.sqrt(before.shape[1]))).max())


_BAD_FITS = 2
"""Minimum number of consecutive bad fits after which the arms are lost [1]."""
_STARTED_AGAIN = 1.0
"""Decrease of timestamps above which tracking starts over [s]."""
_REMEMBERED = 60
"""Number of recent good fits whose median loss is the reference."""
_LOOK_AGE = 1.0
"""Age of an unfinished measurement with the network after which frames are measured with the network again [s]."""
_LOOKED = 1.0
"""Interval between checks for an arm elsewhere in the image [s]."""
_SETTLE, _SIGHT = "settle", "sight"
"""Names of the solvers with `LiveSettings.settle` and `sight`, besides those of each `Effort`."""
_NEAR = 1.75
"""Loss of a state under a prediction from the image alone, relative to `LiveSettings.bad_loss`, above which the frame
is not measured from this state [1]."""
_SETTLED = 0.3
"""Weight of the measurements before a frame that is measured with `LiveSettings.settle` [1], since they were linearized
farther from the solution."""


@dataclass(frozen=True)
class _Attempt:
    """Attempt to measure a frame."""

    effort: Effort
    time: float
    """Timestamp of the frame [s]."""
    state: Gaussian
    """Predicted state of the error model."""
    gap: float
    """Time since the frame of the filtered state [s]."""
    expected: Gaussian
    """Predicted correction."""
    measured: bool = True
    """Whether the frame is measured; otherwise its image does not show the arms near their prediction."""
    settles: bool = False
    """Whether the frame is measured with `LiveSettings.settle`."""


@dataclass
class _Settling:
    """Measurements since a search, and the prior that they are combined with."""

    prior: Gaussian
    """State of the error model before the search: the usual prior or the wider one, whichever is more likely."""
    known: Information
    """Weighted information of the frames since the search."""
    remaining: int
    """Number of frames that are still to be measured."""


@dataclass(frozen=True)
class _Recovery:
    """Attempt that runs on a separate thread."""

    attempt: _Attempt
    frame: Frame
    picture: Picture
    """Thumbnail of the frame."""
    variables: Variables
    found: Future[tuple[Measurement, ColourModel | None]]
    """The measurement, and the colours of the frame."""
    dropped: threading.Event
    """Event that cancels the attempt when set."""


@dataclass(frozen=True)
class _Look:
    """Measurement of a frame with the network, on a separate thread; meanwhile, frames are measured without it."""

    attempt: _Attempt
    frame: Frame
    variables: Variables
    found: Future[tuple[Measurement, ColourModel | None]]
    """The measurement, and the colours of the frame."""
    later: list[tuple[float, Measurement]] = field(default_factory=list)
    """Timestamps [s] and measurements of later frames."""


def _widened(state: Gaussian, factor: float) -> Gaussian:
    """State with a scaled covariance."""
    return Gaussian(state.mean, factor * state.covariance)


class LiveTracker:
    """Tracker of the arms of a scene, frame by frame; frames may be dropped, and times may be irregular.

    Args:
        scene: arms and cameras.
        networks: the networks, or a predictor of surface maps.
        settings: noise, weights and working size; the stages are those of `live`.
        model: model of the measurement error; by default with the network in every eighth frame.
        live: stages, and thresholds for lost arms.
        free: free parameters.
        backgrounds: backgrounds of the cameras; detections in them are false positives.
        cameras: names of the cameras to use, all by default.
        concurrent: whether recovery runs on a separate thread, while later frames are doubtful or lost, and the network
            while later frames are measured by colours; otherwise both delay the result. `close` ends the thread.

    Attributes:
        verdict: verdict of the last frame; lost before the first frame.
    """

    def __init__(
        self,
        scene: Scene,
        networks: FeatureExtractor | SurfacePredictor,
        *,
        settings: SurfaceSolver | None = None,
        model: SequenceSettings | None = None,
        live: LiveSettings | None = None,
        free: FreeParameters | None = None,
        backgrounds: Backgrounds | None = None,
        cameras: Sequence[str] | None = None,
        concurrent: bool = False,
    ) -> None:
        self.settings, self.live = settings or SurfaceSolver(), live or LiveSettings()
        self._scene, self._predictor = scene.with_cameras(cameras), predictor_of(networks)
        self._model, self._free = model or SequenceSettings(look_every=_LOOK_EVERY), free or FreeParameters()
        stages: dict[str, tuple[Stage, ...]] = {
            Effort.SMALL: self.live.small,
            Effort.FULL: self.live.full,
            Effort.SEARCH: self.live.search,
            _SETTLE: self.live.settle,
            _SIGHT: self.live.sight,
        }
        self._solvers = {
            (name, moving): self._solver(each, None if moving else backgrounds)
            for name, each in stages.items()
            for moving in (False, True)
        }
        self._colours = ColourTracker(self._model)
        self._moving = False
        self._errors: ErrorModel | None = None
        self._groups: list[range] = []
        self._pool = ThreadPoolExecutor(1, "recovery") if concurrent else None
        self._start_over()

    def _start_over(self) -> None:
        """Forget all frames."""
        self.verdict = LiveVerdict.LOST
        self._time = -math.inf
        """Timestamp of the last frame [s]."""
        self._filtered: Gaussian | None = None
        """State of the error model after the last good frame."""
        self._seen = -math.inf
        """Timestamp of the last good frame [s]."""
        self._bad_fits = 0
        """Number of consecutive bad fits up to the last frame."""
        self._pose: list[np.ndarray] = []
        """Joint positions of each arm in the last good frame [rad, m]."""
        self._sees = True
        """Whether the last image that was checked shows arms."""
        self._settling: _Settling | None = None
        self._loss = math.nan
        """Loss of the last frame [1]."""
        self._searched = self._looked = -math.inf
        self._elsewhere = False
        """Whether the last check found an arm out of view and a prediction elsewhere."""
        self._losses: deque[float] = deque(maxlen=_REMEMBERED)
        self._recovery: _Recovery | None = None
        self._look: _Look | None = None
        self._gave_up = False
        """Whether the last search was cancelled."""

    def close(self) -> None:
        """Stop the recovery thread after its current frame."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def track(self, frame: Frame, camera_poses: Mapping[str, Float[np.ndarray, "4 4"]] | None = None) -> LiveEstimate:
        """Estimate the next frame.

        If timestamps decrease by more than a second, as with a sender that is started again, tracking starts over.

        Args:
            frame: images, measured joint positions and timestamp.
            camera_poses: camera name -> T_camera_world [m], for cameras whose pose differs from that in the scene.
                In this case backgrounds are not used, since moving cameras have no background.

        Raises:
            SettingsError: an image is missing, or its size differs from that of its camera.
        """
        began = time.perf_counter()
        variables = self._variables(frame, camera_poses or {})
        self._moving = bool(camera_poses or frame.mounts)
        errors, now = self._error_model(variables), frame.timestamp or 0.0
        if now < self._time - _STARTED_AGAIN:
            if self._recovery is not None:
                self._recovery.dropped.set()
            self._start_over()
        self._time = now
        recovered = self._take_recovered(errors)
        self._take_look(errors)
        attempt, measurement = self._measured(frame, variables, errors, now, found_again=recovered is not None)
        self._loss = measurement.loss
        if self._fits(attempt, measurement):
            state, self._bad_fits = self._take(errors, attempt, measurement), 0
            if self._look is not None and self._look.attempt.time < now:
                self._look.later.append((now, measurement))
            self.verdict = LiveVerdict.GOOD
            correction = combined(errors.correction(state), measurement.information)
            if self._arm_is_elsewhere(frame, variables, correction.mean, measurement.loss, now):
                self.verdict = LiveVerdict.DOUBTFUL
        else:
            self._bad_fits += 1
            gone = now - self._seen > self.live.lost_seconds and self._bad_fits >= _BAD_FITS
            self.verdict = LiveVerdict.LOST if gone or self._filtered is None else LiveVerdict.DOUBTFUL
            correction, measurement = self._known(errors, now).expected, measurement.left_out()
        prior = errors.correction(errors.initial())
        visit = Visit(frame.frame_id, variables, measurement, Origin.WARM, 0.0)
        found = visit.estimate(self._scene, frame.index, correction, prior)
        if self.verdict is LiveVerdict.GOOD:
            self._pose = list(found.joint_positions.values())
        return LiveEstimate(
            frame.frame_id,
            now,
            self.verdict,
            recovered or attempt.effort,
            measurement.loss,
            found.state,
            found.joint_positions,
            found.joint_std,
            time.perf_counter() - began,
        )

    def _arm_is_elsewhere(
        self, frame: Frame, variables: Variables, correction: np.ndarray, loss: float, now: float
    ) -> bool:
        """Whether an arm is out of view at its pose, but the network predicts one elsewhere; checked at intervals."""
        if now - self._looked >= _LOOKED:
            solver = self._solvers[Effort.SMALL, self._moving]
            missing = solver.arms_out_of_view(variables, correction)
            self._looked = now
            self._elsewhere = missing and arm_is_elsewhere(solver.evidence(frame, variables, correction, loss))
        return self._elsewhere

    def _known(self, errors: ErrorModel, now: float, effort: Effort = Effort.SMALL) -> _Attempt:
        """Predicted state for a frame; a wider prior for a search."""
        state, gap = errors.initial(), math.inf
        if effort is Effort.SEARCH:
            state = _widened(state, self.live.jump**2)
        elif self._filtered is not None:
            gap = max(now - self._seen, 1e-3)
            state = errors.predicted(self._filtered, gap)
        return _Attempt(effort, now, state, gap, errors.correction(state))

    def _measured(
        self, frame: Frame, variables: Variables, errors: ErrorModel, now: float, *, found_again: bool
    ) -> tuple[_Attempt, Measurement]:
        """Measure by colours or with small effort; after a bad fit, with greater effort, as a recovery if concurrent.

        Args:
            found_again: whether an earlier frame was just recovered.
        """
        small, full = (self._solvers[effort, self._moving] for effort in (Effort.SMALL, Effort.FULL))
        self._drop_outdated(frame)
        attempt, found = self._known(errors, now), None
        if self.verdict is LiveVerdict.LOST and not found_again:
            found = self._unmeasured(frame, variables, attempt)
        elif self.verdict is LiveVerdict.GOOD or found_again:
            found = self._settled(frame, variables, errors, now) or self._by_colours(frame, variables, attempt)
            if found is not None:
                return found
        if found is None:
            found = attempt, small.warm(frame, variables, attempt.expected, attempt.expected.mean)
            fits = self._fits(*found)
            self._colours.learn(small, frame, variables, found[1], fits)
            far = found[1].loss > _NEAR * self.live.bad_loss
            if fits or (far and not self._is_visible(frame, variables, attempt)[0]):
                return found
        effort = self._further(now)
        if effort is Effort.SMALL or self._recovery:
            return found
        hypotheses, search = self._hypotheses(variables, attempt), self._solvers[Effort.SEARCH, self._moving]
        attempt, dropped = self._known(errors, now, effort), threading.Event()

        def more() -> Measurement:
            if effort is Effort.SEARCH:
                sure, expected = self.live.sure_loss, attempt.expected
                return search.search(frame, variables, expected, hypotheses, dropped.is_set, sure_loss=sure)
            return full.warm(frame, variables, attempt.expected, attempt.expected.mean)

        def more_with_colours() -> tuple[Measurement, ColourModel | None]:
            measurement = more()
            return measurement, small.colours(frame, variables, measurement.correction)

        if effort is Effort.SEARCH:
            self._searched = now
        if self._pool is None:
            return attempt, more()
        running = self._pool.submit(more_with_colours)
        self._recovery = _Recovery(attempt, frame, small_picture(frame), variables, running, dropped)
        return found

    def _unmeasured(self, frame: Frame, variables: Variables, attempt: _Attempt) -> tuple[_Attempt, Measurement] | None:
        """Result for a frame whose arms are lost, without a measurement; None if they are visible near their
        prediction."""
        unmeasured = replace(attempt, measured=False)
        nothing = Measurement(attempt.expected.mean, Information.nothing(len(variables)), self._loss, 0)
        if self._recovery is not None and self._recovery.attempt.effort is Effort.SEARCH:
            return unmeasured, nothing
        visible, loss = self._is_visible(frame, variables, attempt)
        if visible and self._filtered is not None and loss <= _NEAR * self.live.bad_loss:
            return None
        return unmeasured, replace(nothing, loss=loss)

    def _is_visible(self, frame: Frame, variables: Variables, attempt: _Attempt) -> tuple[bool, float]:
        """Whether an image shows arms, and the loss of the expected correction under a prediction from the image alone.

        A search starts at once if arms are visible again.
        """
        solver = self._solvers[_SIGHT, self._moving]
        area, loss = solver.visible(frame, variables, attempt.expected.mean)
        before, self._sees = self._sees, area >= self.live.min_visible
        if self._sees != before:
            self._searched = -math.inf if self._sees else attempt.time
        return self._sees, loss

    def _settled(
        self, frame: Frame, variables: Variables, errors: ErrorModel, now: float
    ) -> tuple[_Attempt, Measurement] | None:
        """Measurement of one of the frames after a search with `LiveSettings.settle`; None if the frame is none of
        them, if this measurement runs on the separate thread, or if it does not fit."""
        settling = self._settling
        if settling is None or not settling.remaining or self._look is not None or self._recovery is not None:
            return None
        settling.remaining -= 1
        state = errors.updated(settling.prior, settling.known)
        state = errors.predicted(state, max(now - self._seen, 1e-3))
        attempt = _Attempt(Effort.SMALL, now, state, math.inf, errors.correction(state), settles=True)
        solver = self._solvers[_SETTLE, self._moving]
        if self._pool is not None:
            self._start_look(solver, frame, variables, attempt)
            return None
        found = solver.warm(frame, variables, attempt.expected, attempt.expected.mean)
        fits = self._fits(attempt, found)
        self._colours.learn(solver, frame, variables, found, fits)
        return (attempt, found) if fits else None

    def _by_colours(self, frame: Frame, variables: Variables, attempt: _Attempt) -> tuple[_Attempt, Measurement] | None:
        """Measurement by colours; None if the network is needed. Starts a look of the network if it is due."""
        small = self._solvers[Effort.SMALL, self._moving]
        late = self._look is not None and attempt.time - self._look.attempt.time > _LOOK_AGE
        overdue = self._pool is not None and self._recovery is None and not late
        between = self._colours.measured(small, frame, variables, attempt.expected, overdue=overdue)
        if between is None:
            return None
        if overdue and self._look is None and self._colours.due:
            self._start_look(small, frame, variables, attempt)
        return attempt, between

    def _hypotheses(self, variables: Variables, attempt: _Attempt) -> list[np.ndarray]:
        """Corrections of a frame if the last error persists, and if the arms have not moved since the last good frame.

        A search also compares the measured values.
        """
        if not self._pose:
            return []
        still, correction = variables.joint_offsets(self._pose), attempt.expected.mean
        return [correction, np.where(np.isnan(still), correction, still)]

    def _drop_outdated(self, frame: Frame) -> None:
        """Cancel a search in a frame that no longer resembles the current frame."""
        running = self._recovery
        # A search after a cancelled search runs to completion, so that fast motion does not cancel all searches.
        if running is None or running.attempt.effort is not Effort.SEARCH or self._gave_up:
            return
        picture = small_picture(frame)
        if running.picture.shape == picture.shape and change(running.picture, picture) > CHANGED:
            running.dropped.set()
            self._recovery, self._searched, self._gave_up = None, -math.inf, True

    def _further(self, now: float) -> Effort:
        """Next effort after a bad fit."""
        if self._filtered is not None and self.verdict is not LiveVerdict.LOST:
            return Effort.FULL
        interval = 0.0 if self._filtered is None else self.live.search_seconds
        if not self._sees:
            interval = self.live.blind_seconds
        return Effort.SMALL if now - self._searched < interval else Effort.SEARCH

    def _take_recovered(self, errors: ErrorModel) -> Effort | None:
        """Use the result of a finished recovery unless a later frame was fitted; returns the effort of a used
        result."""
        recovery = self._recovery
        if recovery is None or not recovery.found.done():
            return None
        self._recovery, self._gave_up = None, False
        attempt, (measurement, colours) = recovery.attempt, recovery.found.result()
        if attempt.time <= self._seen or not self._fits(attempt, measurement):
            return None
        self._take(errors, attempt, measurement)
        solver = self._solvers[Effort.SMALL, self._moving]
        self._colours.learn(solver, recovery.frame, recovery.variables, measurement, True, colours)
        return attempt.effort

    def _start_look(self, solver: SequenceFrameSolver, frame: Frame, variables: Variables, attempt: _Attempt) -> None:
        def look() -> tuple[Measurement, ColourModel | None]:
            found = solver.warm(frame, variables, attempt.expected, attempt.expected.mean)
            return found, solver.colours(frame, variables, found.correction)

        assert self._pool is not None
        self._look = _Look(attempt, frame, variables, self._pool.submit(look))

    def _take_look(self, errors: ErrorModel) -> None:
        """Repeat the filter from a frame whose measurement with the network is done, with the later measurements.

        After a bad fit, the colours are dropped, so the next frame is measured with the network.
        """
        look = self._look
        if look is None or not look.found.done():
            return
        self._look = None
        measurement, colours = look.found.result()
        fits = self._fits(look.attempt, measurement)
        solver = self._solvers[Effort.SMALL, self._moving]
        self._colours.learn(solver, look.frame, look.variables, measurement, fits, colours)
        # A recovery or a search since then is newer.
        if fits and self._seen <= (look.later[-1][0] if look.later else look.attempt.time):
            self._take(errors, look.attempt, measurement)
            for time_, later in look.later:
                self._take(errors, self._known(errors, time_), later)

    def _fits(self, attempt: _Attempt, measurement: Measurement) -> bool:
        """Whether a measurement is reliable; without a filtered state, only a search is reliable."""
        if not attempt.measured:
            return False
        if attempt.effort is Effort.SEARCH:
            # Without information, no arm is in view, or an arm is lost.
            return measurement.loss <= self.live.bad_loss and bool(measurement.information.precision.any())
        usual = statistics.median(self._losses) if self._losses else math.inf
        worst = max(self.live.bad_factor * usual, 0.5 * self.live.bad_loss)
        if measurement.loss > min(self.live.bad_loss, worst):
            return False
        return self._filtered is not None and not measurement.information.contradicts(attempt.expected, self._groups)

    def _take(self, errors: ErrorModel, attempt: _Attempt, measurement: Measurement) -> Gaussian:
        """Update the filter with a good frame, weighted for the correlation with the previous frame.

        Returns:
            State of the error model before the frame.
        """
        share, state = math.tanh(0.5 * attempt.gap / self._model.correlation_seconds), attempt.state
        if attempt.effort is Effort.SEARCH:
            usual = errors.initial()
            likely = [measurement.information.log_likelihood(errors.correction(each)) for each in (usual, state)]
            state = usual if likely[0] >= likely[1] else state
            known = measurement.information.scaled(_SETTLED)
            self._settling = _Settling(state, known, self.live.settle_frames)
        elif attempt.settles and self._settling is not None:
            self._settling.known = (self._settling.known + measurement.information).scaled(_SETTLED)
        elif not measurement.by_colours:
            # Losses of other stages are not comparable.
            self._losses.append(measurement.loss)
        self._filtered = errors.updated(state, measurement.information.scaled(share))
        self._seen = attempt.time
        return state

    def _solver(self, warm: tuple[Stage, ...], backgrounds: Backgrounds | None) -> SequenceFrameSolver:
        model = replace(self._model, warm=warm, cold=self.live.search)
        settings = replace(self.settings, stages=warm)
        return SequenceFrameSolver(self._scene, self._predictor, settings, model, lambda _: {}, backgrounds)

    def _variables(self, frame: Frame, camera_poses: Mapping[str, np.ndarray]) -> Variables:
        mounts = mounts_of(self._scene, frame, camera_poses)
        state = self._scene.state(frame.measured, self._predictor.device, mounts)
        return Variables(self._scene, state, self._free, self.settings.length_scale)

    def _error_model(self, variables: Variables) -> ErrorModel:
        if self._errors is None:
            priors = self._model.constant_deg, self.settings.frame_prior_deg, self.settings.intrinsics_prior
            self._errors = ErrorModel(self._model, variables.expected(*priors).cpu().double().numpy())
            self._groups = variables.groups
        return self._errors
