"""Optimizers of the viewer: networks, runs on single frames, runs on many frames, and assessments of poses."""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypedDict, Unpack

import numpy as np
from jaxtyping import Bool

from carts_core import networks, optimization
from carts_core.errors import SettingsError, WeightsError
from carts_core.model.scene import Scene, SceneState
from carts_core.optimization import FreeParameters, SolverSettings, SurfaceSolver
from carts_core.process import leave_a_core_free
from carts_core.project import FitVerdict, Provenance, Source
from carts_core.recording import Sequence as Recording
from carts_core.segmentation import NetworkSegmenter, Segmenter
from carts_core.settings.optimization import Inference
from carts_core.settings.serialization import to_plain
from carts_core.settings.stages import NONE
from carts_core.wording import duration_text
from carts_viewer.state import NETWORK, Pose, Target

if TYPE_CHECKING:
    from carts_core.networks import FeatureExtractor
    from carts_core.optimization import Assessment, FrameOptimizer, Iterate, MaskPredictor, Progress, SequenceOptimizer


class Optimizer(Protocol):
    """Interface of an optimizer of one frame; the app uses `FrameOptimizer`."""

    @property
    def best(self) -> "Iterate | None":
        """During a run, the iterate with the lowest loss for the current observation; at the end, the last iterate."""

    @property
    def stop_reason(self) -> str | None:
        """Reason for the end of the run; None until then."""

    @property
    def assessment(self) -> "Assessment | None":
        """Assessment of the result; None during the run, and if the solver does not assess it."""

    def step(self) -> "Iterate | None":
        """The next iterate, first the initial state; None after the last iterate."""

    def base_frame_gain(self) -> float | None:
        """At the end, the share of the residual that free base frames would explain [1]; None if unknown."""

    @property
    def history(self) -> "list[Progress]":
        """Progress of every iterate."""
        ...

    def comparable_losses(self) -> list[float]:
        """Losses of all iterates, computed with the last observation so that they are comparable."""
        ...


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
    ignore: Mapping[str, Bool[np.ndarray, "height width"]]
    """Camera -> pixels that show an occluder."""


class ActiveRun:
    """One run on one frame."""

    def __init__(self, optimizer: Optimizer, task: FrameTask, provenance: Provenance) -> None:
        self.optimizer, self.provenance = optimizer, provenance
        self.start, self.cameras, self._free = task.pose, task.cameras, task.free
        names = [camera.name for camera in task.sequence.scene.cameras]
        self._rows = [names.index(name) for name in task.cameras]

    def verdict(self) -> FitVerdict | None:
        """Verdict on the result of an ended run; None if the solver does not assess it."""
        found = self.optimizer.assessment
        if found is None:
            return None
        kept = (
            " The initial pose was kept."
            if self.optimizer.stop_reason in (optimization.StopReason.FAILED, optimization.StopReason.START_KEPT)
            else ""
        )
        return FitVerdict(found.verdict.value, f"{found.reason}{kept}", found.remedy, found.probability)

    def pose(self, iterate: "Iterate") -> Pose:
        """Convert an iterate's state, which has the run's cameras only, to a pose of the whole scene.

        Parameters that were not free are copied exactly: rounding must not count as a new calibration of all frames.
        """
        state, start, free = iterate.state.numpy(), self.start.scene, self._free
        extrinsics, intrinsics = start.T_camera_world.copy(), start.intrinsics.copy()
        if free.extrinsics:
            extrinsics[self._rows] = state.T_camera_world
        if free.intrinsics:
            intrinsics[self._rows] = state.intrinsics
        bases = state.T_world_base if free.base_frames else start.T_world_base
        moved = {"T_camera_world": extrinsics, "T_mount_world": start.T_mount_world}
        scene = replace(state, T_world_base=bases, intrinsics=intrinsics, **moved)
        return Pose(scene, Source.OPTIMIZER)


class SequenceRun:
    """One run on many frames: the optimizer and its provenance."""

    def __init__(self, optimizer: "SequenceOptimizer", provenance: Provenance) -> None:
        self.optimizer, self.provenance = optimizer, provenance
        self.cancelled = False

    def cancel(self) -> None:
        """Stop the run; the results so far remain in the optimizer's `estimates`."""
        self.cancelled = True
        self.optimizer.cancel()

    def status(self) -> str:
        """Progress, as text for the user."""
        done, total = self.optimizer.progress
        if done == 0:
            return "Solving single frames for an initial estimate of the kinematic error"
        if done == total:
            return f"All {total} frames estimated; revising inconsistent ones and assessing the fit"
        if done < 2 < total:
            return f"Frame {done} of {total}"  # The first frame takes longer, so it does not predict the time left.
        return f"Frame {done} of {total}, about {duration_text(self.optimizer.seconds_left)} left"


REMEDY = "Fit masks (Fit to), or adapt the network to this recording."
"""Remedy for images outside the domain of the network."""


class NetworkOptions(TypedDict, total=False):
    """Options of the networks."""

    weights: tuple[Path, ...]
    """Weights files; networks without a file have the shipped weights."""
    device: str
    """PyTorch device of the networks, such as `cuda`; `cpu` by default."""
    inference: Inference
    """Runtime of the surface network; `auto` by default."""
    segmenter: Segmenter | None
    """Segmenter of the *Prompt* tool; the shipped network by default."""


class OptimizerFactory:
    """Makes optimizers; loads the networks once, when they are first needed."""

    def __init__(self, *, report: Callable[[str], None], **options: Unpack[NetworkOptions]) -> None:
        self._segmenter = options.get("segmenter")
        self._own_segmenter: tuple[FeatureExtractor, Segmenter] | None = None
        self._weights = options.get("weights", ())
        self._device = options.get("device", "cpu")
        self._inference: Inference = options.get("inference", "auto")
        self.report = report
        self._surface: Path | None = None
        self._extractor: FeatureExtractor | None = None
        self._warnings: dict[tuple[object, ...], tuple[str, ...]] = {}

    def given_surface(self) -> bool:
        """Whether the weights options include a surface network.

        Raises:
            WeightsError: weights cannot be read.
        """
        return any(_is_surface(path) for path in self._weights)

    def use(self, surface: Path | None) -> None:
        """Use another surface network from now on; None for the initial network.

        Raises:
            WeightsError: the weights cannot be read, or are not those of a surface network.
        """
        if surface is not None and not _is_surface(surface):
            raise WeightsError(f"{surface} contains no surface network. Adapt the network again.")
        self._surface, self._extractor = surface, None

    def prepare(self) -> "FeatureExtractor":
        """Load the networks, if they are not loaded yet.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        leave_a_core_free()
        if self._extractor is None:
            self.report("Loading the networks")
            weights = list(self._weights)
            if self._surface is not None:
                others = [path for path in weights if not _is_surface(path)]
                weights = [self._surface, *others]
            self._extractor = networks.FeatureExtractor.load(*weights, device=self._device, inference=self._inference)
        return self._extractor

    @staticmethod
    def forget_images(sequence: Recording) -> None:
        """Drop values computed from the images of a recording."""
        # Without this module, there are none.
        if "carts_core.optimization.observation" in sys.modules:
            optimization.Backgrounds.forget(sequence)

    def segmenter(self) -> Segmenter:
        """The segmenter of the *Prompt* tool.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        if self._segmenter is not None:
            return self._segmenter
        extractor = self.prepare()
        if self._own_segmenter is None or self._own_segmenter[0] is not extractor:
            self._own_segmenter = extractor, NetworkSegmenter.of(extractor)
        return self._own_segmenter[1]

    def domain_warnings(
        self, sequence: Recording, scene: Scene, index: int, domain: str, cameras: Sequence[str]
    ) -> tuple[str, ...]:
        """Warnings that arms or images are outside the domain of the network, based on one frame; cached.

        Raises:
            CartsError: weights or an image is not usable.
        """
        extractor = self.prepare()
        known = extractor.sha256, domain, *cameras
        if known not in self._warnings:
            scene = scene.with_cameras(cameras)
            found = optimization.check_domain(scene, sequence.frame(index, domain, list(cameras)), extractor)
            background = optimization.Backgrounds.of(sequence, cameras, domain).covers(scene)
            self._warnings[known] = tuple(found.warnings(", ".join(cameras), REMEDY, background=background))
        return self._warnings[known]

    def predictor(self, target: Target) -> "FeatureExtractor | MaskPredictor":
        """Predictor of a target; if only masks are fitted, no network is loaded.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        leave_a_core_free()
        if target.observed.what == "network":
            return self.prepare()
        network = None if target.observed.what == "masks" else optimization.NetworkPredictor(self.prepare())
        masks, name = (None, "mask") if target.given is None else (target.given.masks, target.given.origin)
        return optimization.MaskPredictor(network, masks, name)

    def provenance(
        self,
        cameras: Sequence[str],
        settings: SolverSettings,
        free: FreeParameters,
        target: Target = NETWORK,
        source: Source = Source.OPTIMIZER,
        **more: Any,
    ) -> Provenance:
        """Provenance of a run with these settings, and with `more` settings.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        used = {**to_plain(settings), "free": asdict(free), "cameras": list(cameras), **more}
        observed = target.observed
        if observed.what != "network":
            used |= {"observe": observed.what, "masks": observed.masks}
        weights = None if observed.what == "masks" else self.prepare().sha256
        return Provenance.made_by_optimizer(used, weights, source)

    def make(self, task: FrameTask) -> Optimizer:
        """Make an optimizer of a frame.

        Raises:
            CartsError: weights, an image, a mask or a setting is not usable.
        """
        predictor = self.predictor(task.target)
        self.report("Preparing the frame")
        if task.target.observed.what != "network" and not isinstance(task.settings, SurfaceSolver):
            raise SettingsError(
                "The chosen solver compares image features and cannot fit masks. Choose the solver Surface "
                "maps, or fit the network's predictions."
            )
        return self._frame_optimizer(task, predictor)

    def assess(self, task: FrameTask) -> "tuple[Assessment, float]":
        """Assessment and loss of a pose, which is not changed; errors are those of `make`."""
        surface = task.settings if isinstance(task.settings, SurfaceSolver) else SurfaceSolver()
        fixed = replace(task, settings=replace(surface, stages=NONE), free=FreeParameters())
        optimizer = self._frame_optimizer(fixed, self.predictor(task.target))
        for _ in optimizer:
            pass
        assert optimizer.assessment is not None and optimizer.best is not None
        return optimizer.assessment, float(optimizer.best.loss)

    @staticmethod
    def _frame_optimizer(task: FrameTask, predictor: "FeatureExtractor | MaskPredictor") -> "FrameOptimizer":
        sequence, joints, cameras = task.sequence, task.pose.scene.joint_positions, list(task.cameras)
        scene = scene_at(sequence.scene, task.pose.scene)
        return optimization.FrameOptimizer(
            scene,
            sequence.frame(task.index, task.domain, cameras),
            optimization.Backgrounds.of(sequence, cameras, task.domain, required=task.settings.needs_background),
            predictor,
            ignore=task.ignore,
            start={arm.name: values for arm, values in zip(scene.arms, joints, strict=True)},
            settings=task.settings,
            free=task.free,
            cameras=cameras,
        )


def _is_surface(weights: Path) -> bool:
    """Whether a weights file contains a surface network; `WeightsError` if it cannot be read."""
    from carts_core.networks.surface import SurfaceNetwork  # noqa: PLC0415
    from carts_core.networks.weights import read_weights  # noqa: PLC0415

    return read_weights(weights).network.kind == SurfaceNetwork.kind


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
