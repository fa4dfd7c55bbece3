"""Joint calibration of base frames and cameras from many frames."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, stdtrit

from ..errors import SettingsError
from ..model.scene import Scene, SceneState
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from ..recording.background import evenly_spaced
from ..reprs import short_repr
from ..settings import (
    CALIBRATION,
    CALIBRATION_SETTINGS,
    FreeParameters,
    SequenceSettings,
    SolverSettings,
    SurfaceSolver,
    surface_solver,
)
from ..settings.stages import Descend
from .calibration_problem import CalibrationEvaluation, CalibrationProblem, Ignored, with_joint_errors
from .hand_eye.files import STATIONARY_TOLERANCE
from .observation import Backgrounds
from .predictor import SurfacePredictor, predictor_of
from .results import PoseDeviation, Progress, StopReason
from .stages import Fit, Point, run_stages
from .variables import DIFFERENCE_SPAN, Variables
from .verdict import Assessment, Verdict, assess_calibration, check_domain, without_knowledge, worse_in


def calibrated_scene(whole: Scene, part: Scene, variables: Variables, offsets: torch.Tensor) -> Scene:
    """Scene with calibrated values for a subset of its cameras; unchanged values stay bit-identical.

    Args:
        part: the same arms with the calibrated cameras only.
        variables: the unknowns of `part`.
        offsets: offsets of the unknowns from their initial values.
    """
    start, state = variables.start, variables.state(offsets)
    arms = tuple(
        replace(arm, T_world_base=_changed_pose(arm.T_world_base, start, state, "T_world_base", index))
        for index, arm in enumerate(whole.arms)
    )
    cameras = {camera.name: camera for camera in whole.cameras}
    for index, name in enumerate(camera.name for camera in part.cameras):
        camera = cameras[name]
        T_camera_world = _changed_pose(camera.T_camera_world, start, state, "T_camera_world", index)
        before, after = start.intrinsics[index], state.intrinsics[index]
        fx, fy, cx, cy = camera.intrinsics if torch.equal(before, after) else after.tolist()
        cameras[name] = replace(camera, T_camera_world=T_camera_world, intrinsics=(fx, fy, cx, cy))
    return replace(whole, arms=arms, cameras=tuple(cameras.values()))


def _changed_pose(given: np.ndarray, start: SceneState, state: SceneState, name: str, index: int) -> np.ndarray:
    before, after = getattr(start, name)[index], getattr(state, name)[index]
    if torch.equal(before, after):
        return given
    import roma  # noqa: PLC0415 -- it loads torch's compiler, which takes a second

    result = after.cpu().double()
    result[:3, :3] = roma.special_procrustes(result[:3, :3])
    return result.numpy()


_TRIED = 4
"""Maximum number of frames for the domain check."""

_INTRINSICS_ERROR = 0.01
"""Expected error of fixed focal lengths and principal points, as a share of the focal length [1]. It increases standard
deviations and changes no estimate: they are consider parameters (Schmidt, Application of state-space methods to
navigation problems, 1966).
"""

_TOO_FAR = 3.0
"""Maximum motion of a base frame, in its known standard deviations [1]."""

_CORRELATED = SequenceSettings.measurement_noise / SurfaceSolver.noise
"""Ratio of a standard deviation to that for independent pixels, as in sequence mode [1]."""


@dataclass(frozen=True)
class CalibrationIterate:
    """One iterate of a calibration; an immutable copy."""

    index: int
    """Iteration number; 0 for the start."""
    stage: int
    stages: int
    loss: float
    """Weighted mean loss over the frames, comparable within one observation and blur."""
    offsets: Float[torch.Tensor, " n"]
    """Offsets from the start, in radian-like units."""
    scene: Scene
    """Scene with this calibration."""
    frame_losses: Float[np.ndarray, " frames"]
    seconds: float
    """Duration of this iteration [s]."""

    __repr__ = short_repr


@dataclass(frozen=True)
class UnknownChange:
    """Change of one unknown."""

    name: str
    unit: str
    """Unit of all other fields: deg, mm, px or %."""
    change: float
    standard_deviation: float
    """Standard deviation from all modelled errors: frame errors, a common outline error, fixed intrinsics, early
    termination of the optimization, and the prior, which alone determines what the images do not show.
    """
    deviation: float
    """Standard deviation from the curvature alone, for independent pixels."""
    deviation_between_frames: float | None
    """Standard deviation from the differences between frames (jackknife); None with one frame."""
    prior_deviation: float
    """Standard deviation of the prior of the settings; an unknown with a similar `deviation` is not determined by the
    images."""


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration."""

    scene: Scene
    """The given scene with the new calibration."""
    unknowns: tuple[UnknownChange, ...]
    frame_losses_before: Float[np.ndarray, " frames"]
    """Loss of each frame before the calibration, with measured joints, under the last observation."""
    frame_losses_after: Float[np.ndarray, " frames"]
    frame_weights: Float[np.ndarray, " frames"]
    """Weights of the frames, in [0, 1]."""
    stop_reason: StopReason
    assessment: Assessment | None
    """Verdict; None if the run was cancelled."""
    beyond: tuple[str, ...] = ()
    """Arms whose base frame has moved farther than its known covariance allows."""
    deviations: Mapping[tuple[str, str], PoseDeviation] = field(default_factory=dict)
    """(arm, camera) -> standard deviations of the arm's pose relative to that camera in the first frame, at the mean
    tip position."""

    __repr__ = short_repr


class CalibrationOptimizer:
    """Step-wise calibration over many frames; the counterpart of `FrameOptimizer`.

    If all cameras and the base frames of all arms are free and no camera moves, only their product is observable; the
    extrinsics of the first camera are then fixed.

    Args:
        frames: observed images and measured joint positions.
        networks: the networks, or a predictor of surface maps.
        settings: the solver, with its `frame_prior_deg` and `intrinsics_prior`.
        free: unknowns. Free joints have separate values in each frame.
        joint_prior_deg: expected error of free joints [deg].
        ignore: per frame, camera name -> pixels that show an occluder.
        cameras: names of the cameras to use, all by default.
        backgrounds: known mean backgrounds of these cameras, as in `FrameOptimizer`.
        known_base_frames: arm -> covariance of the base frame's rotation and translation in its own axes [rad, m], as
            in `HandEyeResult`, if more accurate than the prior of the settings.

    Raises:
        SettingsError: there are no frames, `joint_prior_deg` is out of range, no calibration parameter is free, the
            settings belong to another solver, or an image is missing or has the wrong size.
        RobotError: a camera or arm does not exist.
    """

    def __init__(
        self,
        scene: Scene,
        frames: Sequence[Frame],
        networks: FeatureExtractor | SurfacePredictor,
        *,
        settings: SolverSettings = CALIBRATION_SETTINGS,
        free: FreeParameters = CALIBRATION,
        joint_prior_deg: float = 0.1,
        ignore: Ignored | None = None,
        cameras: Sequence[str] | None = None,
        backgrounds: Backgrounds | None = None,
        known_base_frames: Mapping[str, Float[np.ndarray, "6 6"]] | None = None,
    ) -> None:
        self.settings = settings = surface_solver(settings, "a calibration")
        if not frames:
            raise SettingsError("no frame was given. A calibration needs at least 1 frame; 20 or more are recommended.")
        if not 1e-3 <= joint_prior_deg <= 360:
            raise SettingsError(f"joint_prior_deg is {joint_prior_deg!r}; allowed: 0.001 to 360 deg.")
        if free.joints_only:
            raise SettingsError("no calibration parameter is free. Free base frames, extrinsics or intrinsics.")
        self._whole_scene, self._scene = scene, scene.with_cameras(cameras)
        # Moving cameras make both cameras and base frames observable.
        still = frames[0].mounts
        moves = any(
            not np.allclose(T, still.get(camera, np.eye(4)), atol=STATIONARY_TOLERANCE)
            for frame in frames
            for camera, T in frame.mounts.items()
        )
        self.free = free if moves else with_fixed_gauge(self._scene, free)
        self._frames, self._predictor = frames, predictor_of(networks)
        self._known = known_base_frames or {}
        problem = self._scene, frames, self._predictor, self.free, settings
        self._problem = CalibrationProblem(*problem, joint_prior_deg, ignore, backgrounds, self._known)
        self.variables = self._problem.variables
        self._fit = Fit(self._problem, torch.zeros_like(self.variables.lower), settings.iterations)
        self._points = self._judged(run_stages(settings.stages, self._fit))
        self._stages = sum(isinstance(stage, Descend) for stage in settings.stages)
        self._best_point: Point | None = None
        self.history: list[Progress] = []
        self.best: CalibrationIterate | None = None
        self.stop_reason: StopReason | None = None
        self.assessment: Assessment | None = None
        """Final verdict. A calibration that failed, or fits worse than the start by any measure, is replaced by the
        start. A doubtful calibration counts as failed if the robot is outside the network's domain.
        """

    def cancel(self) -> None:
        """Stop; `best` and `history` are kept."""
        self.stop_reason = self.stop_reason or StopReason.CANCELLED

    def step(self) -> CalibrationIterate | None:
        """Compute the next iterate; None once the optimization has stopped. Iterate 0 is the start."""
        if self.stop_reason is not None:
            return None
        began = time.perf_counter()
        point = next(self._points, None)
        if point is None:
            self.stop_reason = self._fit.stop_reason
            return None
        evaluation = point.evaluation
        assert isinstance(evaluation, CalibrationEvaluation)
        iterate = CalibrationIterate(
            index=len(self.history),
            stage=self._problem.stage,
            stages=self._stages,
            loss=evaluation.loss,
            offsets=point.offsets.clone(),
            scene=calibrated_scene(self._whole_scene, self._scene, self.variables, point.offsets),
            frame_losses=evaluation.frame_losses.numpy().copy(),
            seconds=time.perf_counter() - began,
        )
        self.history.append(Progress(iterate.index, iterate.loss, iterate.seconds))
        if point.improves_on(self._best_point):
            self.best, self._best_point = iterate, point
        return iterate

    def _judged(self, points: Iterator[Point]) -> Iterator[Point]:
        """Yield the points of the stages, and finally the start if the images contradict the result."""
        yield from points
        last, problem = self._best_point, self._problem
        if last is None or problem.present is None:
            return
        start = torch.zeros_like(last.offsets)
        pairs = list(zip(problem.evidence(start), problem.evidence(last.offsets), strict=True))
        # Frames without an arm say nothing about the calibration, unless no frame shows an arm.
        pairs = [pair for pair in pairs if not all(one.without_arms for one in pair)] or pairs
        before, after = zip(*pairs, strict=True)
        self.assessment = self._with_knowledge(assess_calibration(after))
        if not bool(last.offsets.any()):
            return
        failed = self.assessment.verdict is Verdict.FAILED
        if not failed and not worse_in(before, after):
            return
        if not failed:
            self.assessment = self._with_knowledge(assess_calibration(before))
        self._fit.offsets = start
        self._fit.stop_reason = StopReason.FAILED if failed else StopReason.START_KEPT
        yield replace(self._fit.evaluate(problem.present), objective_key=(*last.objective_key, "start"))

    def _with_knowledge(self, found: Assessment) -> Assessment:
        """Verdict that accounts for arms outside the network's domain; given masks need no network."""
        if found.verdict is not Verdict.DOUBTFUL or self._problem.some_masked:
            return found
        tried = [self._frames[index] for index in evenly_spaced(len(self._frames), _TRIED)]
        known = [check_domain(self._scene, frame, self._predictor, self.settings) for frame in tried]
        return without_knowledge(found, known)

    def __iter__(self) -> Iterator[CalibrationIterate]:
        """Step until the optimization stops."""
        return iter(self.step, None)

    def result(self) -> CalibrationResult:
        """Result at the best iterate of the finest descent that was run; `SettingsError` before the first step."""
        if self.best is None or self._problem.present is None:
            raise SettingsError("no step was taken. Call `step` first.")
        offsets = self.best.offsets
        evaluation = self._problem.evaluate(offsets, self._problem.present)
        assert evaluation.hessian is not None
        alone = torch.linalg.inv(evaluation.hessian.double().cpu())
        between = _between_frames(evaluation)
        total = self._covariance(offsets, evaluation, alone, between)
        return CalibrationResult(
            scene=self.best.scene,
            unknowns=self._changes(offsets, total, alone, between),
            frame_losses_before=self._problem.frame_losses(torch.zeros_like(offsets)),
            frame_losses_after=self._problem.frame_losses(offsets),
            frame_weights=evaluation.frame_weights.numpy().copy(),
            stop_reason=self.stop_reason or StopReason.CANCELLED,
            assessment=self.assessment,
            beyond=tuple(arm for arm in self._known if self._moved_too_far(arm, offsets)),
            deviations=self._pose_deviations(offsets, total.numpy()),
        )

    def _moved_too_far(self, arm: str, offsets: torch.Tensor) -> bool:
        """Whether a base frame has rotated or moved by more than `_TOO_FAR` known standard deviations."""
        rows = [index for index, name in enumerate(self.variables.names) if name.startswith(f"{arm}/base/")]
        moved = offsets[rows].double().cpu().numpy()
        known = with_joint_errors(self._known[arm], self.settings.length_scale)
        return bool(rows) and any(
            np.linalg.norm(moved[part]) > _TOO_FAR * np.sqrt(np.trace(known[part, part]))
            for part in (slice(3), slice(3, 6))
        )

    def _covariance(
        self,
        offsets: torch.Tensor,
        evaluation: CalibrationEvaluation,
        alone: Float[torch.Tensor, "n n"],
        between: Float[torch.Tensor, "n n"] | None,
    ) -> Float[torch.Tensor, "n n"]:
        """Covariance of the unknowns from all modelled errors."""
        assert evaluation.outline is not None
        shifts = [alone @ evaluation.outline[:, None], alone @ evaluation.gradient.double().cpu()[:, None]]
        if not self.free.intrinsics:
            shifts.append(_INTRINSICS_ERROR * alone @ self._problem.curvature_with_intrinsics(offsets))
        together = torch.cat(shifts, 1)
        # The error of the prior, from which directions that the images do not determine get all of their deviation.
        shared = together @ together.T + alone @ self._problem.prior.precision.double().cpu() @ alone
        # With a single frame, the correlation of pixels is taken from the settings.
        frames = _CORRELATED**2 * alone if between is None else between
        total = frames + shared
        wider = _widened(frames.diagonal(), shared.diagonal(), len(self._frames)) / total.diagonal().sqrt()
        return wider[:, None] * total * wider

    def _changes(
        self,
        offsets: torch.Tensor,
        total: Float[torch.Tensor, "n n"],
        alone: Float[torch.Tensor, "n n"],
        between: Float[torch.Tensor, "n n"] | None,
    ) -> tuple[UnknownChange, ...]:
        """Change of each unknown, with its standard deviations."""
        settings = self.settings
        prior = self.variables.expected(settings.prior_deg, settings.frame_prior_deg, settings.intrinsics_prior).cpu()
        known = (offsets.cpu(), total.diagonal().sqrt(), alone.diagonal().sqrt())
        frames = None if between is None else between.diagonal().sqrt()
        changes = []
        for index, (name, unit, scale) in enumerate(self.variables.units()):
            change, deviation, one = (scale * float(values[index]) for values in known)
            other = None if frames is None else scale * float(frames[index])
            changes.append(UnknownChange(name, unit, change, deviation, one, other, scale * float(prior[index])))
        return tuple(changes)

    def _pose_deviations(
        self, offsets: torch.Tensor, covariance: Float[np.ndarray, "n n"]
    ) -> dict[tuple[str, str], PoseDeviation]:
        """Standard deviations of each arm's pose relative to each camera, by central differences; a moving camera is
        that of the first frame."""
        around = self.variables.around(offsets)
        found = {}
        for number, arm in enumerate(self._scene.arms):
            joints = np.stack([frame.measured[arm.name] for frame in self._frames])
            middle = arm.robot.forward_kinematics(joints)[:, -1, :, 3].mean(0)
            for index, camera in enumerate(self._scene.cameras):
                Ts = (around.T_view_world[:, index] @ around.T_world_base[:, number]).double().cpu().numpy()
                turns = Rotation.from_matrix(Ts[:, :3, :3] @ Ts[0, :3, :3].T).as_rotvec()
                below, above = np.split(np.hstack([turns, Ts[:, :3] @ middle])[1:], 2)
                J = (above - below).T / DIFFERENCE_SPAN
                found[arm.name, camera.name] = PoseDeviation.of(J @ covariance @ J.T)
        return found


def _between_frames(evaluation: CalibrationEvaluation) -> Float[torch.Tensor, "n n"] | None:
    """Covariance by the leave-one-frame-out jackknife on the quadratic model; None with a single frame.

    The clusters are frames, whose pixels have correlated errors (CR3: MacKinnon, Nielsen and Webb, Fast
    and reliable jackknife and bootstrap methods for cluster-robust inference, 2023).
    """
    gradients, curvatures = evaluation.frame_gradients, evaluation.frame_curvatures
    assert gradients is not None and curvatures is not None and evaluation.hessian is not None
    count = len(gradients)
    if count < 2:
        return None
    left = torch.linalg.solve(evaluation.hessian.double().cpu() - curvatures, gradients[..., None])[..., 0]
    return left.T @ left * (count - 1) / count


def _widened(
    frames: Float[torch.Tensor, " n"], shared: Float[torch.Tensor, " n"], count: int
) -> Float[torch.Tensor, " n"]:
    """Standard deviations, multiplied by the ratio of Student's t to Gaussian quantiles.

    Args:
        frames: variances estimated from `count` frames, with `count - 1` degrees of freedom.
        shared: known variances of errors common to all frames.
    """
    variance = frames + shared
    if count < 2:
        return variance.sqrt()
    # Welch-Satterthwaite degrees of freedom of a sum (An approximate distribution of estimates of variance
    # components, 1946).
    freedom = (count - 1) * (variance / frames.clamp(min=1e-30)).square()
    wider = stdtrit(freedom.clamp(max=1e9).numpy(), ndtr(1.0))
    return variance.sqrt() * torch.from_numpy(wider)


def with_fixed_gauge(scene: Scene, free: FreeParameters) -> FreeParameters:
    """Lock the first camera in `free` if all cameras and base frames are free, since their common motion is
    unobservable.
    """
    every_base = free.base_frames and (not free.arms or {arm.name for arm in scene.arms} <= set(free.arms))
    names = [camera.name for camera in scene.cameras]
    if not (every_base and free.extrinsics) or set(names) & set(free.locked_cameras):
        return free
    return replace(free, locked_cameras=(*free.locked_cameras, names[0]))
