"""One run on one frame, stepped, and turned into poses of the whole scene."""

from dataclasses import replace
from typing import Protocol

from carts_core.model.scene import Scene
from carts_core.optimization import Assessment, FreeParameters, Iterate, Progress, StopReason
from carts_core.project import FitVerdict, Provenance, Source
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

    @property
    def history(self) -> list[Progress]:
        """What is kept of every iterate."""
        ...

    def comparable_losses(self) -> list[float]:
        """Of all iterates, compared with the last observation, so that they compare."""
        ...


class ActiveRun:
    """One run on one frame: the optimizer, and where it started."""

    def __init__(
        self,
        optimizer: Optimizer,
        scene: Scene,
        start: Pose,
        cameras: tuple[str, ...],
        provenance: Provenance,
        free: FreeParameters,
    ) -> None:
        self._free = free
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

    def verdict(self) -> FitVerdict | None:
        """At the end, how far the result can be relied on; None where the solver does not assess it."""
        found = self._optimizer.assessment
        if found is None:
            return None
        kept = " The start was kept." if self.stop_reason in (StopReason.FAILED, StopReason.START_KEPT) else ""
        return FitVerdict(found.verdict.value, f"{found.reason}{kept}", found.remedy, found.probability)

    @property
    def stages(self) -> tuple[int, ...]:
        """Of each iterate the stage, within which losses compare."""
        return tuple(progress.stage for progress in self._optimizer.history)

    def comparable_losses(self) -> tuple[float, ...]:
        """Of all iterates, compared with the last observation, so that they compare."""
        return tuple(self._optimizer.comparable_losses())

    def base_frame_gain(self) -> float | None:
        """At the end, the share of the residual that free base frames would explain [1]; None if not known."""
        return self._optimizer.base_frame_gain()

    def pose(self, iterate: Iterate) -> Pose:
        """An iterate's state, which knows the run's cameras only, as a pose of the whole scene.

        What was not free is exactly as it was: rounding must not count as a new calibration of all frames.
        """
        state, start, free = iterate.state.to("cpu"), self.start.scene, self._free
        extrinsics, intrinsics = start.T_camera_world.clone(), start.intrinsics.clone()
        if free.extrinsics:
            extrinsics[self._rows] = state.T_camera_world
        if free.intrinsics:
            intrinsics[self._rows] = state.intrinsics
        bases = state.T_world_base if free.base_frames else start.T_world_base
        moved = {"T_camera_world": extrinsics, "T_mount_world": start.T_mount_world}
        scene = replace(state, T_world_base=bases, intrinsics=intrinsics, **moved)
        return Pose(scene, Source.OPTIMIZER)
