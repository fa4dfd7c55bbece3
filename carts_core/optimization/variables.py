"""Mapping between a scene's state and the solver's vector of unknowns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import SettingsError
from ..model.scene import Scene, SceneState
from ..settings import FreeParameters, SurfaceSolver
from .factors import Prior

STEP = 1e-3
"""Step of central differences: offset of each of the two neighbouring states [rad]."""

DIFFERENCE_SPAN = 2 * STEP
"""Distance between the two neighbouring states [rad]."""


@dataclass(frozen=True)
class _Block:
    """Contiguous block of the vector of unknowns."""

    kind: str
    index: int
    """Index of the arm or camera."""
    columns: tuple[int, ...]
    """Free joints of the arm; empty for other kinds."""
    start: int
    size: int


class Variables:
    """Unknowns as one vector of offsets from a start, in radian-like units.

    For prismatic joints and translations, `length_scale` metres count as one radian, so that one step size suits all
    unknowns.

    Args:
        length_scale: translation equivalent to one radian [m/rad].

    Attributes:
        names: name of each unknown.

    Raises:
        SettingsError: no parameter is free, or `free` names a joint that does not exist.
        RobotError: `free` names an arm or a camera that does not exist.
    """

    def __init__(self, scene: Scene, start: SceneState, free: FreeParameters, length_scale: float) -> None:
        self.start = start
        self._length_scale = length_scale
        self.names: list[str] = []
        self._blocks: list[_Block] = []
        self._joint_scales: dict[int, Tensor] = {}
        self._robots = [arm.robot for arm in scene.arms]
        self._check_names(scene, free)
        chosen = [i for i, arm in enumerate(scene.arms) if not free.arms or arm.name in free.arms]
        lower, upper = [], []
        for index in chosen if free.joints else ():
            self._add_joints(scene, index, free, lower, upper)
        for index in chosen if free.base_frames else ():
            self._add("base_frame", index, f"{scene.arms[index].name}/base", ("rx", "ry", "rz", "x", "y", "z"))
        for index, camera in enumerate(scene.cameras):
            if free.extrinsics and camera.name not in free.locked_cameras:
                self._add("extrinsics", index, f"{camera.name}/camera", ("rx", "ry", "rz", "x", "y", "z"))
            if free.intrinsics:
                self._add("intrinsics", index, camera.name, ("fx", "fy", "cx", "cy"))
        if not self.names:
            raise SettingsError("no parameter is free. Free the joints, a base frame or a camera.")
        count, bounded = len(self.names), len(lower)
        device = start.T_world_base.device
        infinite = [float("inf")] * (count - bounded)
        self.lower = torch.tensor([*lower, *(-value for value in infinite)], device=device)
        self.upper = torch.tensor([*upper, *infinite], device=device)

    def _check_names(self, scene: Scene, free: FreeParameters) -> None:
        for name in free.arms:
            scene.arm(name)
        for name in free.locked_cameras:
            scene.camera(name)
        known = {j for arm in scene.arms for j in arm.robot.joint_names}
        known |= {f"{arm.name}/{j}" for arm in scene.arms for j in arm.robot.joint_names}
        for joint in free.locked_joints:
            if joint not in known:
                raise SettingsError(f"locked joint {joint!r} does not exist. Joints: {', '.join(sorted(known))}.")

    def _add(self, kind: str, index: int, owner: str, names: tuple[str, ...], columns: tuple[int, ...] = ()) -> None:
        self._blocks.append(_Block(kind, index, columns, len(self.names), len(names)))
        self.names += [f"{owner}/{name}" for name in names]

    def _add_joints(
        self, scene: Scene, index: int, free: FreeParameters, lower: list[float], upper: list[float]
    ) -> None:
        arm = scene.arms[index]
        columns = tuple(column for column, joint in enumerate(arm.robot.joint_names) if free.frees(arm.name, joint))
        if not columns:
            return
        start = self.start.joint_positions[index].cpu()
        for column in columns:
            scale = self._joint_scale(scene, index, column)
            low, high = arm.robot.joint_limits[column].tolist()
            value = start[..., column]
            # A start outside the limits (such as after a wrong encoder calibration) is allowed, but a joint may not
            # move further out.
            lower.append((min(low, float(value.min())) - float(value.min())) / scale)
            upper.append((max(high, float(value.max())) - float(value.max())) / scale)
        self._add("joints", index, arm.name, tuple(arm.robot.joint_names[c] for c in columns), columns)
        block = self._blocks[-1]
        scales = torch.tensor([self._joint_scale(scene, index, c) for c in columns])
        self._joint_scales[block.start] = scales

    def _joint_scale(self, scene: Scene, index: int, column: int) -> float:
        return self._length_scale if scene.arms[index].robot.joint_types[column] == "prismatic" else 1.0

    def __len__(self) -> int:
        return len(self.names)

    def units(self) -> list[tuple[str, str, float]]:
        """Per unknown: name, display unit (deg, mm, px or % of the focal length), and factor from the internal to the
        display unit."""
        radian, length = ("deg", math.degrees(1.0)), ("mm", 1000.0 * self._length_scale)
        focal = ("%", 100.0)
        read: list[tuple[str, float]] = []
        for block in self._blocks:
            if block.kind == "joints":
                scales = self._joint_scales[block.start].tolist()
                read += [radian if scale == 1.0 else length for scale in scales]
            elif block.kind == "intrinsics":
                fx, fy = self.start.intrinsics[block.index, :2].tolist()
                read += [focal, focal, ("px", fx), ("px", fy)]
            else:
                read += 3 * [radian] + 3 * [length]
        return [(name, *unit) for name, unit in zip(self.names, read, strict=True)]

    def joint_offsets(self, joint_positions: Sequence[ArrayLike]) -> Float[np.ndarray, " n"]:
        """Offsets that move the arms to joint positions [rad, m], by at most half a turn for joints without limits; NaN
        for unknowns other than joints."""
        offsets = np.full(len(self), math.nan)
        for block in self._blocks:
            if block.kind == "joints":
                columns = list(block.columns)
                start = self.start.joint_positions[block.index].cpu().double().numpy()
                step = self._robots[block.index].difference(joint_positions[block.index], start)[columns]
                offsets[block.start : block.start + block.size] = step / self._joint_scales[block.start].numpy()
        return offsets

    @property
    def groups(self) -> list[range]:
        """Index ranges of the joints of an arm, a base frame, and the extrinsics and the intrinsics of a camera."""
        return [range(block.start, block.start + block.size) for block in self._blocks]

    @property
    def moves_calibration(self) -> bool:
        """Whether base frames, extrinsics or intrinsics are among the unknowns."""
        return any(block.kind != "joints" for block in self._blocks)

    @property
    def scales(self) -> Float[Tensor, " n"]:
        """Scale per unknown: value of a unit offset, 1 for angles and intrinsics, `length_scale` [m] for lengths."""
        scales = torch.ones_like(self.lower)
        for block in self._blocks:
            part = scales[block.start : block.start + block.size]
            if block.kind == "joints":
                part.copy_(self._joint_scales[block.start])
            elif block.kind != "intrinsics":
                part[3:] = self._length_scale
        return scales

    def expected(self, joints_deg: float, frames_deg: float, intrinsics: float) -> Float[Tensor, " n"]:
        """Expected error of each unknown [rad].

        Args:
            joints_deg: expected error of initial joint positions [deg]; `length_scale` converts it to metres.
            frames_deg: expected error of base frames and camera extrinsics [deg].
            intrinsics: expected error of focal lengths and principal points, as a share of the focal length [1].
        """
        expected = torch.full_like(self.lower, intrinsics)
        for block in self._blocks:
            if block.kind != "intrinsics":
                degrees = joints_deg if block.kind == "joints" else frames_deg
                expected[block.start : block.start + block.size] = math.radians(degrees)
        return expected

    def standard_deviations(self, joints_deg: float, frames_deg: float, distance: float) -> Float[Tensor, " n"]:
        """Standard deviations of a search [rad]; 0 for intrinsics.

        Args:
            joints_deg: standard deviation of joint positions [deg]; `length_scale` converts it to metres.
            frames_deg: standard deviation of rotations of base frames and cameras [deg]; half of this angle times
                `distance` is the standard deviation of translations.
            distance: distance of the arms from the cameras [m].
        """
        deviation = self.expected(joints_deg, frames_deg, 0.0)
        for block in self._blocks:
            if block.kind in ("base_frame", "extrinsics"):
                deviation[block.start + 3 : block.start + 6] *= 0.5 * distance / self._length_scale
        return deviation

    def prior(self, settings: SurfaceSolver) -> Prior:
        """Prior of independent errors around the start, with the standard deviations of the settings."""
        expected = self.expected(settings.prior_deg, settings.frame_prior_deg, settings.intrinsics_prior)
        return Prior.around_start(expected**-2)

    def clamp(self, offsets: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
        """Clamp offsets to the joint limits."""
        return torch.minimum(torch.maximum(offsets, self.lower), self.upper)

    def state(self, offsets: Float[Tensor, "*batch n"]) -> SceneState:
        """The scene's state at the given offsets, differentiable."""
        batch = offsets.shape[:-1]
        start = self.start.map(lambda value: value.expand(*batch, *value.shape)) if batch else self.start
        joints = list(start.joint_positions)
        T_world_base, T_camera_world, intrinsics = start.T_world_base, start.T_camera_world, start.intrinsics
        for block in self._blocks:
            part = offsets[..., block.start : block.start + block.size]
            if block.kind == "joints":
                columns = torch.tensor(block.columns, device=part.device)
                step = part * self._joint_scales[block.start].to(part)
                joints[block.index] = joints[block.index].index_add(-1, columns, step)
            elif block.kind == "base_frame":
                # The base frame rotates about its own origin, the remote centre, not about the world origin.
                T_world_base = _update(T_world_base, block.index, lambda T, s=part: T @ self._rigid(s))
            elif block.kind == "extrinsics":
                T_camera_world = _update(T_camera_world, block.index, lambda T, s=part: self._rigid(s) @ T)
            else:
                # A unit offset scales a focal length by e, and moves a principal point by the focal length.
                intrinsics = _update(
                    intrinsics,
                    block.index,
                    lambda K, s=part: torch.cat(
                        [K[..., :2] * torch.exp(s[..., :2]), K[..., 2:] + K[..., :2] * s[..., 2:]], -1
                    ),
                    matrix=False,
                )
        return SceneState(tuple(joints), T_world_base, T_camera_world, intrinsics, start.T_mount_world)

    def around(self, offsets: Float[Tensor, " n"]) -> SceneState:
        """States for central differences [1 + 2 n]: the state itself, then with each unknown decreased by `STEP`, then
        increased."""
        step = STEP * torch.eye(len(offsets), device=offsets.device)
        return self.state(torch.cat([offsets[None], offsets - step, offsets + step]))

    def _rigid(self, step: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
        import roma  # noqa: PLC0415 -- it loads torch's compiler, which takes a second; joints do not need it

        rotation = roma.rotvec_to_rotmat(step[..., :3])
        translation = step[..., 3:] * self._length_scale
        top = torch.cat([rotation, translation[..., None]], -1)
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], device=step.device).expand(*step.shape[:-1], 1, 4)
        return torch.cat([top, bottom], -2)


def _update(stack: Tensor, index: int, change, *, matrix: bool = True) -> Tensor:
    """Copy of `stack` with the entry `index` of arms or cameras replaced by `change(entry)`."""
    dim = -3 if matrix else -2
    parts = list(stack.unbind(dim))
    parts[index] = change(parts[index])
    return torch.stack(parts, dim)
