"""Makes what optimizes: frames alone, frames together, and what only compares a pose with its images."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np
import torch
from jaxtyping import Bool

from carts_core.errors import SettingsError
from carts_core.model.scene import Scene, SceneState
from carts_core.networks import FeatureExtractor
from carts_core.optimization import (
    Assessment,
    Backgrounds,
    FrameOptimizer,
    FreeParameters,
    MaskPredictor,
    NetworkPredictor,
    SequenceOptimizer,
    SequenceSettings,
    SolverSettings,
    SurfaceSolver,
)
from carts_core.optimization.measurement import Ignore
from carts_core.project import Provenance, Source
from carts_core.recording import Sequence as Recording
from carts_core.settings import Direction
from carts_core.settings.serialization import to_plain
from carts_core.settings.stages import NONE
from carts_viewer.active_run import Optimizer
from carts_viewer.loading import NetworkLoader
from carts_viewer.observing import NETWORK, Target
from carts_viewer.sequence_run import SequenceRun
from carts_viewer.state import Pose


class OptimizerFactory(NetworkLoader):
    """Makes optimizers."""

    def predictor(self, target: Target) -> FeatureExtractor | MaskPredictor:
        """What says what images show; with masks alone no network is loaded.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        if target.observed.what == "network":
            return self.prepare()
        network = None if target.observed.what == "masks" else NetworkPredictor(self.prepare())
        masks, name = (None, "mask") if target.given is None else (target.given.masks, target.given.origin)
        return MaskPredictor(network, masks, name)

    def provenance(
        self, cameras: Sequence[str], settings: SolverSettings, free: FreeParameters, target: Target = NETWORK
    ) -> Provenance:
        """What a project keeps about a run with these settings.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        used = {**to_plain(settings), "free": asdict(free), "cameras": list(cameras), **self._observed(target)}
        return Provenance.made_by_optimizer(used, self._weights_hash(target))

    def _weights_hash(self, target: Target) -> str | None:
        return None if target.observed.what == "masks" else self.prepare().sha256

    @staticmethod
    def _observed(target: Target) -> dict[str, str]:
        observed = target.observed
        return {} if observed.what == "network" else {"observe": observed.what, "masks": observed.masks}

    def make(
        self,
        sequence: Recording,
        index: int,
        domain: str,
        cameras: Sequence[str],
        pose: Pose,
        settings: SolverSettings,
        free: FreeParameters,
        target: Target,
        ignore: Mapping[str, Bool[np.ndarray, "height width"]],
    ) -> Optimizer:
        """An optimizer that starts at the pose and fits the target; `ignore` says which pixels of which camera show an
        occluder.

        Raises:
            CartsError: weights, an image, a mask or a setting is not usable.
        """
        predictor = self.predictor(target)
        self.report("Preparing the frame")
        if target.observed.what != "network" and not isinstance(settings, SurfaceSolver):
            raise SettingsError(
                "The chosen solver compares features of images, so it cannot fit masks. Choose the solver Surface "
                "maps, or fit what the network sees."
            )
        return self._frame_optimizer(sequence, index, domain, cameras, pose, settings, free, ignore, predictor)

    def assess(
        self,
        sequence: Recording,
        index: int,
        domain: str,
        cameras: Sequence[str],
        pose: Pose,
        settings: SolverSettings,
        target: Target,
        ignore: Mapping[str, Bool[np.ndarray, "height width"]],
    ) -> tuple[Assessment, float]:
        """What the images say of a pose, and its loss; nothing moves. Arguments and errors as in `make`."""
        surface = settings if isinstance(settings, SurfaceSolver) else SurfaceSolver()
        optimizer = self._frame_optimizer(
            sequence,
            index,
            domain,
            cameras,
            pose,
            replace(surface, stages=NONE),
            FreeParameters(),
            ignore,
            self.predictor(target),
        )
        for _ in optimizer:
            pass
        assert optimizer.assessment is not None and optimizer.best is not None
        return optimizer.assessment, float(optimizer.best.loss)

    @staticmethod
    def _frame_optimizer(
        sequence: Recording,
        index: int,
        domain: str,
        cameras: Sequence[str],
        pose: Pose,
        settings: SolverSettings,
        free: FreeParameters,
        ignore: Mapping[str, Bool[np.ndarray, "height width"]],
        predictor: FeatureExtractor | MaskPredictor,
    ) -> FrameOptimizer:
        frame = sequence.frame(index, domain, list(cameras))
        backgrounds = Backgrounds.of(sequence, cameras, domain, required=settings.needs_background)
        scene = scene_at(sequence.scene, pose.scene)
        start = {arm.name: values.numpy() for arm, values in zip(scene.arms, pose.scene.joint_positions, strict=True)}
        return FrameOptimizer(
            scene,
            frame,
            backgrounds,
            predictor,
            ignore=ignore,
            start=start,
            settings=settings,
            free=free,
            cameras=list(cameras),
        )

    def make_sequence(
        self,
        sequence: Recording,
        calibration: SceneState,
        frames: range,
        domain: str,
        cameras: Sequence[str],
        settings: SolverSettings,
        direction: Direction,
        free: FreeParameters,
        keyframes: Mapping[int, Mapping[str, np.ndarray]],
        keyframe_std: Mapping[int, Mapping[str, np.ndarray]],
        target: Target,
        ignore: Ignore,
    ) -> SequenceRun:
        """A run on frames together; joints are free as in a run on one frame, calibration is not.

        Args:
            sequence: Where joint positions are measured.
            calibration: Base frames and cameras; its joint positions do not matter.
            frames: Which ones; of a `domain`, seen by `cameras`.
            settings: Of the optimizer.
            direction: Where to begin.
            free: Which joints may move.
            keyframes: Frame -> arm -> joint positions [rad, m] that stay; `keyframe_std`: their standard deviations.
            target: What is fitted.
            ignore: Frame -> camera -> pixels that show something else.

        Raises:
            CartsError: weights, an image, a mask or a setting is not usable.
        """
        model = SequenceSettings(direction=direction)
        free = replace(free, base_frames=False, extrinsics=False, intrinsics=False)
        stamps = sequence.timestamps
        optimizer = SequenceOptimizer(
            scene_at(sequence.scene, calibration),
            lambda index: sequence.frame(index, domain, list(cameras)),
            {index: None if stamps is None else float(stamps[index]) for index in frames},
            self.predictor(target),
            settings=settings,
            model=model,
            free=free,
            keyframes=keyframes,
            keyframe_std=keyframe_std,
            ignore=ignore,
            backgrounds=Backgrounds.of(sequence, cameras, domain),
            cameras=list(cameras),
        )
        used = {
            **to_plain(settings),
            "model": to_plain(model),
            "free": asdict(free),
            "cameras": list(cameras),
            "frames": [frames[0], frames[-1]],
            "keyframes": sorted(keyframes),
            **self._observed(target),
        }
        made = Provenance.made_by_optimizer(used, self._weights_hash(target), Source.PROPAGATED)
        return SequenceRun(optimizer, made)


def scene_at(scene: Scene, state: SceneState) -> Scene:
    """The scene with base frames, extrinsics and intrinsics of a state in place of the calibrated ones."""

    def array(value: torch.Tensor):
        return value.numpy().astype("float64")

    arms = [replace(arm, T_world_base=array(T)) for arm, T in zip(scene.arms, state.T_world_base, strict=True)]
    cameras = [
        replace(camera, T_camera_world=array(T), intrinsics=tuple(k.tolist()))
        for camera, T, k in zip(scene.cameras, state.T_camera_world, state.intrinsics, strict=True)
    ]
    return replace(scene, arms=tuple(arms), cameras=tuple(cameras))
