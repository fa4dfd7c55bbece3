"""The solver of the page: runs, checks of fits, refined masks and segmentation.

Tasks and results contain NumPy arrays and can be sent to another process (`solver_process.py`).
"""

from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt8

from carts_core import networks, optimization
from carts_core.errors import CartsError, SettingsError
from carts_core.model.scene import Scene, SceneState
from carts_core.networks.header import is_surface
from carts_core.optimization import FreeParameters, Iterate, SolverSettings, StopReason, SurfaceSolver
from carts_core.optimization.results import PoseDeviation
from carts_core.process import leave_a_core_free
from carts_core.project import FitVerdict, IgnoreRegion
from carts_core.project.values import VERDICTS
from carts_core.recording import Sequence as Recording
from carts_core.segmentation import NetworkSegmenter, Prompt, Segmenter
from carts_core.segmentation.onnx_segmenter import OnnxSegmenter
from carts_core.settings import SequenceSettings
from carts_core.settings.optimization import Inference
from carts_core.settings.stages import NONE
from carts_core.wording import duration_text
from carts_viewer.jobs.live_stream import LiveEnded, LiveStep, LiveTask, tracked_stream
from carts_viewer.state import Pose, Target

if TYPE_CHECKING:
    from carts_core.networks import FeatureExtractor
    from carts_core.optimization import Assessment, FrameEstimate, FrameOptimizer, MaskPredictor, SequenceOptimizer

Masks = Mapping[str, Bool[np.ndarray, "height width"]]
"""Camera -> pixels."""


@dataclass(frozen=True)
class NetworkChoice:
    """The networks of a task."""

    weights: tuple[Path, ...] = ()
    """Weights files; networks without a file have the shipped weights."""
    surface: Path | None = None
    """Weights of the surface network, in place of those in `weights`."""
    device: str = "cpu"
    """PyTorch device of the networks."""
    inference: Inference = "auto"
    """Runtime of the surface network."""
    segmenter: tuple[Path, Path] | None = None
    """Encoder and decoder of the segmenter, as ONNX files; None for the shipped one."""


@dataclass(frozen=True, eq=False)
class FrameTask:
    """A frame to optimize or assess."""

    sequence: Recording
    index: int
    domain: str
    cameras: tuple[str, ...]
    pose: Pose
    """Initial state."""
    settings: SolverSettings
    free: FreeParameters
    target: Target
    ignore: Masks
    """Camera -> ignored pixels, for all cameras of the scene that have such pixels."""
    shown: bool = False
    """Whether the run is displayed: the domain of the network is checked first, and the result is assessed."""


@dataclass(frozen=True, eq=False)
class RefineTask:
    """Rendered masks to refine."""

    sequence: Recording
    index: int
    domain: str
    cameras: tuple[str, ...]
    """Cameras of the state."""
    state: SceneState
    rendered: Masks
    ignore: Masks


@dataclass(frozen=True, eq=False)
class CalibrationTask:
    """Frames to calibrate on."""

    sequence: Recording
    indices: tuple[int, ...]
    domain: str
    start: "Calibration"
    free: FreeParameters
    target: Target
    ignore: tuple[Masks, ...] | None = None
    """Per frame, camera -> ignored pixels; None for no ignored pixels."""
    backgrounds: bool = True
    """Whether the mean background of the recording is used."""
    known_base_frames: Mapping[str, Float[np.ndarray, "6 6"]] = field(default_factory=dict)
    """Arm -> covariance of its base frame, as in `HandEyeResult`."""


@dataclass(frozen=True, eq=False)
class SequenceTask:
    """Frames to solve together."""

    sequence: Recording
    frames: range
    domain: str
    cameras: tuple[str, ...]
    state: SceneState
    """State with the calibration."""
    settings: SolverSettings
    model: SequenceSettings
    free: FreeParameters
    target: Target
    keyframes: Mapping[int, Mapping[str, Float[np.ndarray, " dofs"]]]
    keyframe_std: Mapping[int, Mapping[str, Float[np.ndarray, " dofs"]]]
    regions: Mapping[int, Mapping[str, IgnoreRegion]]
    """Frame -> camera -> pixels that show an occluder."""


@dataclass(frozen=True)
class Started:
    """First result of every run."""

    weights_sha256: str | None
    """Fingerprint of the networks; None if only masks are fitted."""
    warnings: tuple[str, ...] = ()
    """Warnings that arms or images are outside the domain of the network."""


@dataclass(frozen=True)
class Advanced:
    """An iterate of a run."""

    iterate: Iterate
    stage: int
    best: int
    """Index of the best iterate so far."""


@dataclass(frozen=True)
class Stepped:
    """An iterate of a run that is not displayed, so it is not sent."""


@dataclass(frozen=True)
class Ended:
    """Last result of a run; only that of a displayed run is assessed."""

    best: Iterate | None
    stop_reason: str | None
    verdict: FitVerdict | None = None
    losses: tuple[float, ...] = ()
    """Losses of all iterates, comparable across stages."""
    base_frame_gain: float | None = None
    """The share of the residual that free base frames would explain [1]; None if unknown."""


RunResult = Started | Advanced | Stepped | Ended


@dataclass(frozen=True)
class Fit:
    """Fit of a pose to the images of its frame."""

    verdict: FitVerdict
    loss: float
    """Mean loss of the cameras with an arm in view [1]."""
    dice: float | None = None
    """Lowest Dice overlap with a ground-truth mask over all cameras; None without such a mask."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one frame of a sequence."""

    index: int
    joint_positions: Mapping[str, Float[np.ndarray, " dofs"]]
    joint_std: Mapping[str, Float[np.ndarray, " dofs"]]
    loss: float
    keyframe: bool
    """Whether the joint positions were given."""


@dataclass(frozen=True)
class SequenceStep:
    """A visited frame of a sequence."""

    done: int
    """Number of visited frames."""
    text: str
    """Progress, as text for the user."""
    estimate: Estimate | None
    """Estimate from the frames visited so far; None for the initial runs on single frames."""


@dataclass(frozen=True)
class Smoothed:
    """Estimates of all visited frames, at the end."""

    estimates: Mapping[int, Estimate]


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated values of the arms and cameras of a scene."""

    T_world_base: tuple[Float[np.ndarray, "4 4"], ...]
    T_camera_world: tuple[Float[np.ndarray, "4 4"], ...]
    intrinsics: tuple[tuple[float, float, float, float], ...]

    @staticmethod
    def of(scene: Scene) -> "Calibration":
        """Values of a scene."""
        return Calibration(
            tuple(arm.T_world_base for arm in scene.arms),
            tuple(camera.T_camera_world for camera in scene.cameras),
            tuple(camera.intrinsics for camera in scene.cameras),
        )

    def applied_to(self, scene: Scene) -> Scene:
        """The scene with this calibration."""
        arms = [replace(arm, T_world_base=T) for arm, T in zip(scene.arms, self.T_world_base, strict=True)]
        cameras = [
            replace(camera, T_camera_world=T, intrinsics=k)
            for camera, T, k in zip(scene.cameras, self.T_camera_world, self.intrinsics, strict=True)
        ]
        return replace(scene, arms=tuple(arms), cameras=tuple(cameras))


@dataclass(frozen=True)
class CalibrationStep:
    """An iterate of a calibration."""

    index: int
    stage: int
    stages: int
    loss: float
    calibration: Calibration


@dataclass(frozen=True)
class Calibrated:
    """Result of a calibration."""

    calibration: Calibration
    stop_reason: StopReason
    loss_before: float
    """Initial mean loss of the frames [1]."""
    loss_after: float
    deviations: Mapping[tuple[str, str], PoseDeviation]
    """(arm, camera) -> standard deviations of the arm's pose relative to that camera."""
    changes: tuple[str, ...]
    """Change of each unknown, as text for the user."""
    moved: str
    """Motions of the calibrated poses, as text for the user; empty if there are none."""
    beyond: str
    """Warning about base frames that moved farther than their known covariance allows; empty if there are none."""
    verdict: str
    """good, doubtful or failed; empty if there is no verdict."""
    reason: str
    """Reason for the verdict, with a remedy."""


_REMEDY = "Fit masks (Fit to), or adapt the network to this recording."
"""Remedy for images outside the domain of the network."""
_OUT_OF_VIEW = 5e-4
"""Share of an image that arms must cover to count as in view of the camera [1]."""


class Solver:
    """Carries out tasks; loads the networks once, when they are first needed.

    Methods that return an iterator compute one result per step.

    Raises:
        CartsError: weights, an image, a mask or a setting of a task is not usable.
    """

    def __init__(self, choice: NetworkChoice, report: Callable[[str], None]) -> None:
        """`report`: called with a text for the user about a preparation."""
        self._choice, self._report = choice, report
        self._extractor: FeatureExtractor | None = None
        self._segmenter: Segmenter | None = None
        self._warnings: dict[tuple[object, ...], tuple[str, ...]] = {}

    def extractor(self) -> "FeatureExtractor":
        """Load the networks, if they are not loaded yet."""
        leave_a_core_free()
        if self._extractor is None:
            self._report("Loading the networks")
            weights, surface = list(self._choice.weights), self._choice.surface
            if surface is not None:
                weights = [surface, *(path for path in weights if not is_surface(path))]
            self._extractor = networks.FeatureExtractor.load(
                *weights, device=self._choice.device, inference=self._choice.inference
            )
        return self._extractor

    def segmenter(self) -> Segmenter:
        """Load the segmenter, if it is not loaded yet."""
        if self._segmenter is None:
            files = self._choice.segmenter
            own = None if files is None else OnnxSegmenter.load(*files)
            self._segmenter = own or NetworkSegmenter.of(self.extractor())
        return self._segmenter

    def prepare(self) -> str:
        """Load the networks; returns their fingerprint."""
        fingerprint = self.extractor().sha256
        if self._choice.segmenter is not None:
            self.segmenter()
        return fingerprint

    @staticmethod
    def forget_images(sequence: Recording) -> None:
        """Drop images of a recording and values computed from them."""
        sequence.forget_images()
        optimization.Backgrounds.forget(sequence)

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """Mask of the object of a prompt."""
        return self.segmenter().segment(image, prompt)

    def run(self, task: FrameTask) -> Iterator[RunResult]:
        """Optimize a frame; yields `Started`, `Advanced` or `Stepped` for each iterate, and `Ended`."""
        self._report("Preparing the frame")
        optimizer = self._frame_optimizer(task)
        weights = self._weights(task.target)
        yield Started(weights, self._domain_warnings(task) if task.shown else ())
        while (iterate := optimizer.step()) is not None:
            if task.shown:
                best = optimizer.best
                yield Advanced(_plain(iterate), optimizer.history[-1].stage, best.index if best else 0)
            else:
                yield Stepped()
        best = None if optimizer.best is None else _plain(optimizer.best)
        if not task.shown:
            yield Ended(best, optimizer.stop_reason)
            return
        verdict = None if best is None else self._verdict(task, best, optimizer)
        losses = tuple(optimizer.comparable_losses())
        yield Ended(best, optimizer.stop_reason, verdict, losses, optimizer.base_frame_gain())

    def compare(self, task: FrameTask) -> Iterate | None:
        """The iterate at a pose, with its maps."""
        iterate = self._frame_optimizer(task).step()
        return None if iterate is None else _plain(iterate)

    def fit(self, task: FrameTask) -> Fit:
        """The fit of a pose in all cameras of the task that can be compared with the target."""
        surface = task.settings if isinstance(task.settings, SurfaceSolver) else SurfaceSolver()
        fixed = replace(task, settings=replace(surface, stages=NONE), free=FreeParameters())
        found: dict[str, tuple[Assessment, float]] = {}
        for name in task.target.seen(task.sequence, task.index, task.domain, task.cameras) or task.cameras:
            optimizer = self._frame_optimizer(replace(fixed, cameras=(name,)))
            for _ in optimizer:
                pass
            assert optimizer.assessment is not None and optimizer.best is not None
            found[name] = optimizer.assessment, float(optimizer.best.loss)
        # Cameras without an arm in view are ignored, unless no camera has an arm in view.
        seeing = {name: one for name, one in found.items() if one[0].evidence.area >= _OUT_OF_VIEW} or found
        loss = sum(loss for _, loss in seeing.values()) / len(seeing)
        return Fit(frame_verdict({name: assessment for name, (assessment, _) in seeing.items()}), loss)

    def refine(self, task: RefineTask) -> Masks:
        """Refined masks of the cameras in `rendered`."""
        predictor = optimization.NetworkPredictor(self.extractor())
        scene, masks = scene_at(task.sequence.scene.with_cameras(task.cameras), task.state), {}
        frame = task.sequence.frame(task.index, task.domain, list(task.rendered))
        for camera, rendered in task.rendered.items():
            backgrounds = optimization.Backgrounds.of(task.sequence, (camera,), task.domain)
            refiner = optimization.MaskRefiner(predictor, backgrounds)
            masks |= refiner.refine(scene, frame, task.state, {camera: rendered}, task.ignore)
        return masks

    def calibration(self, task: CalibrationTask) -> Iterator[Started | CalibrationStep | Calibrated]:
        """Calibrate on frames; yields `Started`, the iterates, and `Calibrated`."""
        from carts_core.evaluation.calibration import beyond_prior  # noqa: PLC0415

        sequence, scene = task.sequence, task.start.applied_to(task.sequence.scene)
        cameras = [camera.name for camera in scene.cameras]
        predictor = self._predictor(task.target)
        yield Started(self._weights(task.target))
        optimizer = optimization.CalibrationOptimizer(
            scene,
            [sequence.frame(index, task.domain, cameras) for index in task.indices],
            predictor,
            free=replace(task.free, joints=False),
            ignore=None if task.ignore is None else list(task.ignore),
            backgrounds=optimization.Backgrounds.of(sequence, cameras, task.domain) if task.backgrounds else None,
            known_base_frames=task.known_base_frames,
        )
        for iterate in optimizer:
            calibration = Calibration.of(iterate.scene)
            yield CalibrationStep(iterate.index, iterate.stage, iterate.stages, iterate.loss, calibration)
        result = optimizer.result()
        units = {"deg": "°"}
        changes = [
            f"{one.name}: {one.change:+.3f} ± {one.standard_deviation:.3f}{units.get(one.unit, f' {one.unit}')}"
            for one in result.unknowns
        ]
        found = result.assessment
        yield Calibrated(
            Calibration.of(result.scene),
            result.stop_reason,
            float(np.mean(result.frame_losses_before)),
            float(np.mean(result.frame_losses_after)),
            result.deviations,
            tuple(changes),
            _moved(scene, result.scene),
            beyond_prior(scene, result, task.known_base_frames) or "",
            "" if found is None else found.verdict.value,
            "" if found is None else f"{found.reason} {found.remedy}".strip(),
        )

    def sequence(self, task: SequenceTask) -> Generator[Started | SequenceStep | Smoothed | float | None, bool, None]:
        """Solve frames together; yields `Started`, a `SequenceStep` per frame, `Smoothed`, and the base frame gain.

        A true value that is sent in stops the visits.
        """
        sequence, stamps, cameras = task.sequence, task.sequence.timestamps, list(task.cameras)
        optimizer = optimization.SequenceOptimizer(
            scene_at(sequence.scene, task.state),
            lambda index: sequence.frame(index, task.domain, cameras),
            {index: None if stamps is None else float(stamps[index]) for index in task.frames},
            self._predictor(task.target),
            settings=task.settings,
            model=task.model,
            free=task.free,
            keyframes=task.keyframes,
            keyframe_std=task.keyframe_std,
            ignore=lambda index: task.target.ignored(task.regions.get(index, {}), index, cameras),
            backgrounds=optimization.Backgrounds.of(sequence, cameras, task.domain),
            cameras=cameras,
        )
        cancelled = yield Started(self._weights(task.target))
        visited = 0
        while not cancelled and (estimate := optimizer.step()) is not None:
            done, visited = optimizer.progress[0] - visited, optimizer.progress[0]
            # The initial runs on single frames visit no frame.
            kept = _estimate(estimate) if done or visited == len(task.frames) else None
            cancelled = yield SequenceStep(visited, _status(optimizer), kept)
        if cancelled:
            optimizer.cancel()
        yield Smoothed({index: _estimate(found) for index, found in optimizer.estimates.items()})
        yield optimizer.base_frame_gain()

    def live(self, task: LiveTask) -> Generator[LiveStep | LiveEnded, bool | None, None]:
        """Track a stream; see `tracked_stream`."""
        return tracked_stream(task, scene_at(task.sequence.scene, task.state), self.extractor())

    def _predictor(self, target: Target) -> "FeatureExtractor | MaskPredictor":
        """Predictor of a target; if only masks are fitted, no network is loaded."""
        leave_a_core_free()
        if target.observed.what == "network":
            return self.extractor()
        network = None if target.observed.what == "masks" else optimization.NetworkPredictor(self.extractor())
        masks, name = (None, "mask") if target.given is None else (target.given.masks, target.given.origin)
        return optimization.MaskPredictor(network, masks, name)

    def _weights(self, target: Target) -> str | None:
        return None if target.observed.what == "masks" else self.extractor().sha256

    def _frame_optimizer(self, task: FrameTask) -> "FrameOptimizer":
        predictor = self._predictor(task.target)
        if task.target.observed.what != "network" and not isinstance(task.settings, SurfaceSolver):
            raise SettingsError(
                "The chosen solver compares image features and cannot fit masks. Choose the solver Surface "
                "maps, or fit the network's predictions."
            )
        sequence, joints, cameras = task.sequence, task.pose.scene.joint_positions, list(task.cameras)
        scene = scene_at(sequence.scene, task.pose.scene)
        return optimization.FrameOptimizer(
            scene,
            sequence.frame(task.index, task.domain, cameras),
            optimization.Backgrounds.of(sequence, cameras, task.domain, required=task.settings.needs_background),
            predictor,
            ignore={name: mask for name, mask in task.ignore.items() if name in cameras},
            start={arm.name: values for arm, values in zip(scene.arms, joints, strict=True)},
            settings=task.settings,
            free=task.free,
            cameras=cameras,
        )

    def _verdict(self, task: FrameTask, end: Iterate, optimizer: "FrameOptimizer") -> FitVerdict | None:
        """Verdict at the end of a run; with several cameras, each camera is assessed individually."""
        found, own, cameras = optimizer.assessment, None, task.sequence.scene.cameras
        if found is not None:
            kept = optimizer.stop_reason in (StopReason.FAILED, StopReason.START_KEPT)
            reason = f"{found.reason} The initial pose was kept." if kept else found.reason
            own = FitVerdict(found.verdict.value, reason, found.remedy, found.probability)
            if len(cameras) == 1 or own.verdict == "failed":
                return own
        pose = replace(task.pose, scene=result_state(task, end))
        try:
            return self.fit(replace(task, pose=pose, cameras=tuple(camera.name for camera in cameras))).verdict
        except CartsError:
            # There is no surface network, and the solver does not need one.
            return own

    def _domain_warnings(self, task: FrameTask) -> tuple[str, ...]:
        """Warnings that arms or images are outside the domain of the network, based on one frame; cached."""
        if task.target.observed.what != "network" or not isinstance(task.settings, SurfaceSolver):
            return ()
        sequence, domain, cameras = task.sequence, task.domain, task.cameras
        known = str(sequence.path), domain, *cameras
        if known not in self._warnings:
            scene, extractor = scene_at(sequence.scene, task.pose.scene).with_cameras(cameras), self.extractor()
            found = optimization.check_domain(scene, sequence.frame(task.index, domain, list(cameras)), extractor)
            background = optimization.Backgrounds.of(sequence, cameras, domain).covers(scene)
            self._warnings[known] = tuple(found.warnings(", ".join(cameras), _REMEDY, background=background))
        return self._warnings[known]


def frame_verdict(assessed: "dict[str, Assessment]") -> FitVerdict:
    """Verdict on a frame: the worst verdict of its cameras."""
    worst = max(assessed, key=lambda name: (VERDICTS.index(assessed[name].verdict.value), assessed[name].probability))
    found = assessed[worst]
    verdict = FitVerdict(found.verdict.value, found.reason, found.remedy, found.probability)
    if len(assessed) == 1:
        return verdict
    cameras = tuple((name, one.probability) for name, one in assessed.items())
    reason = found.reason if found.verdict.value == VERDICTS[0] else f"Camera {worst}: {found.reason}"
    return replace(verdict, reason=reason, cameras=cameras)


def result_state(task: FrameTask, iterate: Iterate) -> SceneState:
    """State of the whole scene at an iterate, which has the run's cameras only.

    Parameters that were not free are copied exactly: rounding must not count as a new calibration of all frames.
    """
    names = [camera.name for camera in task.sequence.scene.cameras]
    rows = [names.index(name) for name in task.cameras]
    state, start, free = iterate.state, task.pose.scene, task.free
    extrinsics, intrinsics = start.T_camera_world.copy(), start.intrinsics.copy()
    if free.extrinsics:
        extrinsics[rows] = state.T_camera_world
    if free.intrinsics:
        intrinsics[rows] = state.intrinsics
    bases = state.T_world_base if free.base_frames else start.T_world_base
    moved = {"T_camera_world": extrinsics, "T_mount_world": start.T_mount_world}
    return replace(state, T_world_base=bases, intrinsics=intrinsics, **moved)


def scene_at(scene: Scene, state: SceneState) -> Scene:
    """The scene with base frames, extrinsics and intrinsics of a state."""
    arms = [
        replace(arm, T_world_base=T.astype(np.float64)) for arm, T in zip(scene.arms, state.T_world_base, strict=True)
    ]
    cameras = [
        replace(camera, T_camera_world=T.astype(np.float64), intrinsics=tuple(k.tolist()))
        for camera, T, k in zip(scene.cameras, state.T_camera_world, state.intrinsics, strict=True)
    ]
    return replace(scene, arms=tuple(arms), cameras=tuple(cameras))


def _plain(iterate: Iterate) -> Iterate:
    return replace(iterate, state=iterate.state.numpy())


def _estimate(found: "FrameEstimate") -> Estimate:
    given = found.start == "keyframe"
    return Estimate(found.index, found.joint_positions, found.joint_std, float(found.loss), given)


def _status(optimizer: "SequenceOptimizer") -> str:
    """Progress, as text for the user."""
    done, total = optimizer.progress
    if done == 0:
        return "Solving single frames for an initial estimate of the kinematic error"
    if done == total:
        return f"All {total} frames estimated; revising inconsistent ones and assessing the fit"
    if done < 2 < total:
        return f"Frame {done} of {total}"  # The first frame takes longer, so it does not predict the time left.
    return f"Frame {done} of {total}, about {duration_text(optimizer.seconds_left)} left"


def _moved(before: Scene, after: Scene) -> str:
    """Text with angles and distances of the poses that a calibration has moved; empty if there are none."""
    from carts_core.evaluation.calibration import moved_frames  # noqa: PLC0415

    found = [f"{name} by {angle:.1f}° and {way:.1f} mm" for name, angle, way in moved_frames(before, after)]
    return f" Moved: {', '.join(found)}." if found else ""
