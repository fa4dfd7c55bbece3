"""The optimizer as the viewer drives it: made for one frame, stepped, and turned into poses of the whole scene."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool

from carts_core.model.scene import Scene, SceneState
from carts_core.networks import FeatureExtractor
from carts_core.optimization import (
    Assessment,
    Backgrounds,
    FrameEstimate,
    FrameOptimizer,
    FreeParameters,
    Iterate,
    SequenceAssessment,
    SequenceOptimizer,
    SequenceSettings,
    SolverSettings,
    StopReason,
    Verdict,
)
from carts_core.optimization.measurement import Ignore
from carts_core.project import Provenance, Source
from carts_core.recording import Sequence as Recording
from carts_core.settings import Direction
from carts_core.settings.inference import Inference
from carts_core.settings.serialization import to_plain
from carts_viewer.state import Pose


class Optimizer(Protocol):
    """What the viewer needs of an optimizer; `FrameOptimizer` is the one that the app uses."""

    @property
    def best(self) -> Iterate | None:
        """The best iterate so far: of the present observation, the one of the lowest loss; at the end, the last."""

    @property
    def stop_reason(self) -> str | None:
        """Why there are no more iterates, None before."""

    @property
    def assessment(self) -> Assessment | None:
        """At the end, how far the result can be relied on; None before, and where it is not assessed."""

    def step(self) -> Iterate | None:
        """The next iterate, the start itself at first; None when there are no more."""

    def base_frame_gain(self) -> float | None:
        """At the end, the share of the residual that free base frames would explain [1]; None if not known."""


class OptimizerFactory:
    """Makes optimizers; loads the networks once, when they are first needed."""

    def __init__(
        self,
        *,
        weights: Sequence[Path] = (),
        device: str = "cpu",
        inference: Inference = "auto",
        report: Callable[[str], None],
    ) -> None:
        """
        Args:
            weights: Weights files; a network that none is given of is the shipped one.
            device: Where to compute.
            inference: Who runs the surface network.
            report: Called with a line for people about what takes long.
        """
        self._weights = weights
        self._device = device
        self._inference: Inference = inference
        self._report = report
        self._extractor: FeatureExtractor | None = None

    def prepare(self) -> FeatureExtractor:
        """The networks.

        Raises:
            WeightsError: it cannot be loaded.
        """
        if self._extractor is None:
            self._report("Loading the networks")
            self._extractor = FeatureExtractor.load(*self._weights, device=self._device, inference=self._inference)
        return self._extractor

    def provenance(self, cameras: Sequence[str], settings: SolverSettings, free: FreeParameters) -> Provenance:
        """What a project keeps about a run with these settings.

        Raises:
            WeightsError: the networks cannot be loaded.
        """
        used = {**to_plain(settings), "free": asdict(free), "cameras": list(cameras)}
        return Provenance.made_by_optimizer(used, self.prepare().sha256)

    def make(
        self,
        sequence: Recording,
        index: int,
        domain: str,
        cameras: Sequence[str],
        pose: Pose,
        settings: SolverSettings,
        free: FreeParameters,
        ignore: Mapping[str, Bool[np.ndarray, "height width"]],
    ) -> Optimizer:
        """An optimizer that starts at the pose; `ignore` says which pixels of which camera show an occluder.

        Raises:
            CartsError: weights, an image or a setting is not usable.
        """
        extractor = self.prepare()
        self._report("Preparing the frame")
        frame = sequence.frame(index, domain, list(cameras))
        backgrounds = Backgrounds.of(sequence, cameras, domain, required=settings.needs_background)
        scene = scene_at(sequence.scene, pose.scene)
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
        ignore: Ignore,
    ) -> "SequenceRun":
        """A run on frames together; joints are free as in a run on one frame, calibration is not.

        Args:
            sequence: Where joint positions are measured.
            calibration: Base frames and cameras; its joint positions do not matter.
            frames: Which ones.
            domain: Of the images.
            cameras: Whose images count.
            settings: Of the optimizer.
            direction: Where to begin.
            free: Which joints may move.
            keyframes: Frame -> arm -> joint positions [rad, m] that stay.
            ignore: Frame -> camera -> pixels that show something else.

        Raises:
            CartsError: weights, an image or a setting is not usable.
        """
        extractor = self.prepare()
        model = SequenceSettings(direction=direction)
        free = replace(free, base_frames=False, extrinsics=False, intrinsics=False)
        stamps = sequence.timestamps
        optimizer = SequenceOptimizer(
            scene_at(sequence.scene, calibration),
            lambda index: sequence.frame(index, domain, list(cameras)),
            {index: None if stamps is None else float(stamps[index]) for index in frames},
            extractor,
            settings=settings,
            model=model,
            free=free,
            keyframes=keyframes,
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
        }
        return SequenceRun(optimizer, Provenance.made_by_optimizer(used, extractor.sha256, Source.PROPAGATED))


class SequenceRun:
    """One run on many frames: the optimizer, and what a project keeps about it."""

    def __init__(self, optimizer: SequenceOptimizer, provenance: Provenance) -> None:
        self.provenance = provenance
        self.cancelled = False
        self._optimizer = optimizer

    @property
    def done(self) -> int:
        """Frames that were visited."""
        return self._optimizer.progress[0]

    def step(self) -> bool:
        """Visit the next frame; False when there are no more."""
        return self._optimizer.step() is not None

    def cancel(self) -> None:
        """Stop; what was reached stays in `estimates`."""
        self.cancelled = True
        self._optimizer.cancel()

    def estimates(self) -> dict[int, FrameEstimate]:
        """Of every frame that was visited, in the light of all of them."""
        return self._optimizer.estimates

    @property
    def assessment(self) -> SequenceAssessment | None:
        """At the end, how far all frames together can be relied on; None before, and of a run that was stopped."""
        return self._optimizer.assessment

    def status(self) -> str:
        """How it goes, for people."""
        done, total = self._optimizer.progress
        if done == 0:
            return "Estimating a few frames to choose where to begin"
        if done == total:
            return f"All {total} frames estimated, revising those that disagree and judging the fit"
        seconds = self._optimizer.seconds_left
        left = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
        return f"Frame {done} of {total}, about {left} left"


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
        """The best iterate so far: of the present observation, the one of the lowest loss; at the end, the last."""
        return self._optimizer.best

    def verdict(self) -> str | None:
        """At the end, for people, why the result is not reliable and what to try; None where it is."""
        found = self._optimizer.assessment
        if found is None or found.verdict is Verdict.GOOD:
            return None
        kept = " The start was kept." if self.stop_reason in (StopReason.FAILED, StopReason.START_KEPT) else ""
        return f"{found.verdict.value.capitalize()}: {found.reason}{kept} {found.remedy}"

    def base_frame_gain(self) -> float | None:
        """At the end, the share of the residual that free base frames would explain [1]; None if not known."""
        return self._optimizer.base_frame_gain()

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
