"""Follows arms through a stream, forwards only: the filter of sequence mode, with as little work a frame as will do."""

import math
import statistics
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from ..model.scene import Scene, SceneState
from ..networks.extractor import FeatureExtractor
from ..optimization.counterfactual import Backgrounds
from ..optimization.error_model import ErrorModel, Gaussian, combined
from ..optimization.measurement import FrameSolver, Measurement
from ..optimization.predictor import SurfacePredictor, predictor_of
from ..optimization.sequence_estimate import Origin, Visit
from ..optimization.variables import Variables
from ..recording import Frame
from ..settings import FreeParameters, SequenceSettings, SurfaceSolver
from ..settings.live import LiveSettings
from ..settings.stages import Stage
from .moments import mounts_of

_REMEMBERED = 60
"""Good fits whose losses tell what is usual."""
_CONTRADICTS = 9.0
"""A correction three deviations off what was expected, on average, contradicts it."""


class LiveVerdict(StrEnum):
    """How far an estimate can be relied on."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    """The image does not fit for the moment: what is shown is what the frames before let expect."""
    LOST = "lost"
    """Nothing is known but the measured values and what they were off by when the arms were last seen."""


class Effort(StrEnum):
    """What was done with a frame."""

    SMALL = "small"
    FULL = "full"
    SEARCH = "search"


@dataclass(frozen=True)
class LiveEstimate:
    """One frame, in the light of those before it."""

    frame_id: str
    time: float
    """When it was taken [s]."""
    verdict: LiveVerdict
    effort: Effort
    loss: float
    """Of the surface factor [1]."""
    state: SceneState
    joint_positions: Mapping[str, Float[np.ndarray, " dofs"]]
    """Arm name -> [rad, m]."""
    joint_std: Mapping[str, Float[np.ndarray, " dofs"]]
    """Arm name -> standard deviation [rad, m]; NaN where a joint is not free."""
    seconds: float
    """Spent on it [s]."""


class LiveTracker:
    """Follows the arms of a scene. One frame at a time; frames may be left out, and times need not be even.

    Args:
        scene: arms and cameras.
        networks: the networks, or another predictor of surface maps.
        settings: noise, weights and working size; the stages are those of `live`.
        model: of the measurement error.
        live: stages, and what counts as a bad fit.
        free: what is unknown.
        backgrounds: of the cameras; what looks like an arm in them is taken for none.
        cameras: names of the cameras that take part, all by default.

    Attributes:
        verdict: on the last frame; lost before the first one.
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
    ) -> None:
        self.settings, self.live, self.verdict = settings or SurfaceSolver(), live or LiveSettings(), LiveVerdict.LOST
        self._scene, self._predictor = scene.with_cameras(cameras), predictor_of(networks)
        self._model, self._free = model or SequenceSettings(), free or FreeParameters()
        self._solvers = {
            (effort, moving): self._solver(stages, None if moving else backgrounds)
            for effort, stages in ((Effort.SMALL, self.live.small), (Effort.FULL, self.live.full))
            for moving in (False, True)
        }
        self._moving = False
        self._errors: ErrorModel | None = None
        self._filtered: Gaussian | None = None
        """Of the parts of the error, after the last good frame."""
        self._seen = -math.inf
        """When the last good frame was taken [s]."""
        self._searched = -math.inf
        self._losses: deque[float] = deque(maxlen=_REMEMBERED)

    def track(self, frame: Frame, camera_poses: Mapping[str, Float[np.ndarray, "4 4"]] | None = None) -> LiveEstimate:
        """The estimate of a frame that is newer than those before.

        Args:
            frame: images, measured joint positions, and when they were taken.
            camera_poses: camera name -> T_camera_world [m], where it is not that of the scene. What cameras that move
                see without arms is not known, so backgrounds are left out then.

        Raises:
            SettingsError: an image is missing or of another size than its camera.
        """
        began = time.perf_counter()
        variables = self._variables(frame, camera_poses or {})
        self._moving = bool(camera_poses or frame.mounts)
        errors, now = self._error_model(variables), frame.timestamp or 0.0
        state, gap = errors.initial(), math.inf
        if self._filtered is not None:
            gap = max(now - self._seen, 1e-3)
            state = errors.predicted(self._filtered, gap)
        expected = errors.correction(state)
        effort, measurement = self._measured(frame, variables, expected, now)
        if self._bad(measurement) or (effort is not Effort.SEARCH and _contradicts(measurement, expected)):
            self.verdict = self._missed(now)
            correction, measurement = expected, measurement.left_out()
        else:
            if effort is Effort.SEARCH:
                state, gap = errors.initial(), math.inf
            self._take(errors, state, measurement, gap, now)
            self.verdict = LiveVerdict.GOOD
            correction = combined(errors.correction(state), measurement.information)
        prior = errors.correction(errors.initial())
        visit = Visit(frame.frame_id, variables, measurement, Origin.WARM, 0.0)
        found = visit.estimate(self._scene, frame.index, correction, prior)
        return LiveEstimate(
            frame.frame_id,
            now,
            self.verdict,
            effort,
            measurement.loss,
            found.state,
            found.joint_positions,
            found.joint_std,
            time.perf_counter() - began,
        )

    def _measured(
        self, frame: Frame, variables: Variables, expected: Gaussian, now: float
    ) -> tuple[Effort, Measurement]:
        """With no more effort than it takes."""
        small, full = (self._solvers[effort, self._moving] for effort in (Effort.SMALL, Effort.FULL))
        if self._filtered is not None:
            found = small.warm(frame, variables, expected, expected.mean)
            if not (self._bad(found) or _contradicts(found, expected)):
                return Effort.SMALL, found
            if self.verdict is not LiveVerdict.LOST:
                return Effort.FULL, full.warm(frame, variables, expected, expected.mean)
            if now - self._searched < self.live.search_seconds:
                return Effort.SMALL, found
        self._searched = now
        errors = self._error_model(variables)
        prior = errors.correction(errors.initial())
        return Effort.SEARCH, small.cold(frame, variables, prior)

    def _bad(self, measurement: Measurement) -> bool:
        usual = statistics.median(self._losses) if self._losses else math.inf
        return measurement.loss > min(self.live.bad_loss, max(self.live.bad_factor * usual, 0.5 * self.live.bad_loss))

    def _missed(self, now: float) -> LiveVerdict:
        gone = self._filtered is None or now - self._seen > self.live.lost_seconds
        return LiveVerdict.LOST if gone else LiveVerdict.DOUBTFUL

    def _take(self, errors: ErrorModel, state: Gaussian, measurement: Measurement, gap: float, now: float) -> None:
        """What a good frame says, for those after it; frames that follow each other fast say much the same."""
        share = math.tanh(0.5 * gap / self._model.correlation_seconds)
        self._filtered = errors.updated(state, measurement.information.scaled(share))
        self._seen = now
        self._losses.append(measurement.loss)

    def _solver(self, warm: tuple[Stage, ...], backgrounds: Backgrounds | None) -> FrameSolver:
        model = replace(self._model, warm=warm, cold=self.live.search)
        settings = replace(self.settings, stages=warm)
        return FrameSolver(self._scene, self._predictor, settings, model, lambda _: {}, backgrounds)

    def _variables(self, frame: Frame, camera_poses: Mapping[str, np.ndarray]) -> Variables:
        mounts = mounts_of(self._scene, frame, camera_poses)
        state = self._scene.state(frame.measured, self._predictor.device, mounts)
        return Variables(self._scene, state, self._free, self.settings.length_scale)

    def _error_model(self, variables: Variables) -> ErrorModel:
        if self._errors is None:
            priors = self._model.constant_deg, self.settings.frame_prior_deg, self.settings.intrinsics_prior
            self._errors = ErrorModel(self._model, variables.expected(*priors).cpu().double().numpy())
        return self._errors


def _contradicts(measurement: Measurement, expected: Gaussian) -> bool:
    return measurement.information.mahalanobis(expected) > _CONTRADICTS
