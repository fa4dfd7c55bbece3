"""The optimizer as the viewer drives it: made for one frame, stepped, and turned into poses of the whole scene."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool

from carts_core.data import Sequence as Recording
from carts_core.features import FeatureExtractor
from carts_core.optimization import FrameOptimizer, FreeParameters, Iterate, OptimizerSettings
from carts_core.project import Provenance, Source
from carts_core.scene import Scene, SceneState
from carts_viewer.state import Pose


class Optimizer(Protocol):
    """What the viewer needs of an optimizer; `FrameOptimizer` is the one that the app uses."""

    @property
    def best(self) -> Iterate | None:
        """The iterate of the lowest loss so far."""

    @property
    def stop_reason(self) -> str | None:
        """Why there are no more iterates, None before."""

    def step(self) -> Iterate | None:
        """The next iterate, the start itself at first; None when there are no more."""


class OptimizerFactory:
    """Makes optimizers for frames of one sequence; loads the networks once, when it is first needed."""

    def __init__(
        self, sequence: Recording, *, weights: Sequence[Path] = (), device: str = "cpu", report: Callable[[str], None]
    ) -> None:
        """
        Args:
            sequence: The recording.
            weights: Weights files; a network that none is given of is the shipped one.
            device: Where to compute.
            report: Told, for people, what takes long.
        """
        self._sequence = sequence
        self._weights = weights
        self._device = device
        self._report = report
        self._extractor: FeatureExtractor | None = None

    def prepare(self) -> FeatureExtractor:
        """The networks.

        Raises:
            WeightsError: it cannot be loaded.
        """
        if self._extractor is None:
            self._report("Loading the networks")
            self._extractor = FeatureExtractor.load(*self._weights, device=self._device)
        return self._extractor

    def provenance(self, cameras: Sequence[str], settings: OptimizerSettings, free: FreeParameters) -> Provenance:
        """What a project keeps about a run with these settings.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        used = {**asdict(settings), "free": asdict(free), "cameras": list(cameras)}
        return Provenance.made_by_optimizer(used, self.prepare().sha256)

    def make(
        self,
        index: int,
        domain: str,
        cameras: Sequence[str],
        pose: Pose,
        settings: OptimizerSettings,
        free: FreeParameters,
        ignore: Mapping[str, Bool[np.ndarray, "height width"]],
    ) -> Optimizer:
        """An optimizer that starts at the pose; `ignore` says which pixels of which camera show an occluder.

        Raises:
            CartsError: weights, an image or a setting is not usable.
        """
        extractor = self.prepare()
        self._report("Preparing the frame")
        frame = self._sequence.frame(index, domain, list(cameras))
        backgrounds = {camera: self._sequence.background(camera, domain) for camera in cameras}
        scene = scene_at(self._sequence.scene, pose.scene)
        start = {arm.name: values.numpy() for arm, values in zip(scene.arms, pose.scene.joint_positions, strict=True)}
        return FrameOptimizer(
            scene,
            frame,
            backgrounds,
            extractor,
            ignore=ignore,
            start=start,
            settings=settings,
            free=free,
            cameras=list(cameras),
        )


class ActiveRun:
    """One run on one frame: the optimizer, and where it started."""

    def __init__(
        self, optimizer: Optimizer, scene: Scene, start: Pose, cameras: tuple[str, ...], provenance: Provenance
    ) -> None:
        self.start = start
        self.provenance = provenance
        self.cameras = cameras
        self._optimizer = optimizer
        self._rows = [[camera.name for camera in scene.cameras].index(name) for name in cameras]

    @property
    def stop_reason(self) -> str | None:
        """Why the run ended, None before."""
        return self._optimizer.stop_reason

    def step(self) -> Iterate | None:
        """The next iterate; None when there are no more."""
        return self._optimizer.step()

    def best(self) -> Iterate | None:
        """The iterate of the lowest loss so far."""
        return self._optimizer.best

    def pose(self, iterate: Iterate) -> Pose:
        """An iterate's state, which knows the run's cameras only, as a pose of the whole scene."""
        state = iterate.state.to("cpu")
        extrinsics = self.start.scene.T_camera_world.clone()
        intrinsics = self.start.scene.intrinsics.clone()
        extrinsics[self._rows] = state.T_camera_world
        intrinsics[self._rows] = state.intrinsics
        return Pose(replace(state, T_camera_world=extrinsics, intrinsics=intrinsics), Source.OPTIMIZER)


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
