"""Scene with arms, cameras and a light, and its optimizable state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..arrays import Array, as_array
from ..errors import RobotError
from ..reprs import short_repr
from ..wording import closest
from .camera import Camera
from .robot import Robot


@dataclass(frozen=True)
class Arm:
    """Robot with its base frame in the world."""

    name: str
    robot: Robot
    T_world_base: Float[np.ndarray, "4 4"]
    """Base frame of the arm (F_B of the paper)."""

    __repr__ = short_repr


@dataclass(frozen=True)
class Light:
    """White point light fixed to the camera (L_d of the paper), and the reflection model of surfaces."""

    position: tuple[float, float, float] = (0.0, 0.0, -0.02)
    """Position in the camera's frame [m]; behind the lens by default."""
    ambient: float = 0.25
    """Ambient reflection, relative to a surface's colour."""
    diffuse: float = 0.75
    """Diffuse reflection, relative to a surface's colour."""
    specular: float = 0.35
    """Brightness of the highlight."""
    shininess: float = 24.0
    """Phong exponent of the highlight."""


@dataclass(frozen=True)
class SceneState:
    """Optimizable values of a scene: a point, or a batch of points, in parameter space.

    Fields are tensors, which may carry gradients, or NumPy arrays; `*batch` dimensions are hypotheses.
    """

    joint_positions: tuple[Float[Array, "*batch dofs"], ...]
    """Joint positions of each arm, in the scene's order [rad, m] (K of the paper)."""
    T_world_base: Float[Array, "*batch arms 4 4"]
    """Base frames (F_B of the paper)."""
    T_camera_world: Float[Array, "*batch cameras 4 4"]
    """Camera extrinsics (C of the paper); `T_camera_mount` for a moving camera."""
    intrinsics: Float[Array, "*batch cameras 4"]
    """fx, fy, cx, cy of the full-size image [px]."""
    T_mount_world: Float[Array, "*batch cameras 4 4"]
    """Measured poses of the camera mounts in this frame; the identity for static cameras."""

    __repr__ = short_repr

    @property
    def T_view_world(self) -> Float[Array, "*batch cameras 4 4"]:
        """Transforms from the world to each camera in this frame."""
        return self.T_camera_world @ self.T_mount_world

    def map(self, function) -> "SceneState":
        """Apply a function to every field."""
        return SceneState(
            tuple(function(value) for value in self.joint_positions),
            function(self.T_world_base),
            function(self.T_camera_world),
            function(self.intrinsics),
            function(self.T_mount_world),
        )

    def with_camera(self, index: int) -> "SceneState":
        """The state of the scene with one of its cameras only."""
        return replace(
            self,
            T_camera_world=self.T_camera_world[..., index : index + 1, :, :],
            intrinsics=self.intrinsics[..., index : index + 1, :],
            T_mount_world=self.T_mount_world[..., index : index + 1, :, :],
        )

    def detached(self) -> "SceneState":
        """Copy that shares neither memory nor gradients with this state."""
        return self.map(lambda value: value.detach().clone())

    def to(self, device: Any) -> "SceneState":
        """The state as tensors on a PyTorch device."""
        import torch  # noqa: PLC0415

        return self.map(lambda value: torch.as_tensor(value, device=device))

    def numpy(self) -> "SceneState":
        """The state as NumPy arrays, without gradients; memory is shared if possible."""
        return self.map(as_array)


@dataclass(frozen=True)
class Scene:
    """Arms, cameras and light, which are constant during the optimization of a frame."""

    arms: tuple[Arm, ...]
    cameras: tuple[Camera, ...]
    light: Light = field(default_factory=Light)

    __repr__ = short_repr

    def arm(self, name: str) -> Arm:
        """Look up an arm by name.

        Raises:
            RobotError: there is no such name.
        """
        for arm in self.arms:
            if arm.name == name:
                return arm
        known = [arm.name for arm in self.arms]
        raise RobotError(f"there is no arm {name!r}. The arms are: {', '.join(known)}.{closest(name, known)}")

    def camera(self, name: str) -> Camera:
        """Look up a camera by name.

        Raises:
            RobotError: there is no such name.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = [camera.name for camera in self.cameras]
        raise RobotError(f"there is no camera {name!r}. The cameras are: {', '.join(known)}.{closest(name, known)}")

    def with_cameras(self, names: Sequence[str] | None) -> "Scene":
        """Copy of the scene with only these cameras, in this order; None for all cameras."""
        return self if names is None else replace(self, cameras=tuple(self.camera(name) for name in names))

    def with_arms(self, names: Sequence[str] | None) -> "Scene":
        """Copy of the scene with only these arms, in the scene's order; None for all arms."""
        if names is None:
            return self
        wanted = {self.arm(name).name for name in names}
        return replace(self, arms=tuple(arm for arm in self.arms if arm.name in wanted))

    def distance(self, state: SceneState) -> float:
        """Median distance of the link centres from the cameras [m], at one state (no batch)."""
        state, found = state.numpy(), []
        for arm, joints, T_world_base in zip(self.arms, state.joint_positions, state.T_world_base, strict=True):
            Ts = state.T_view_world[:, None] @ (T_world_base @ arm.robot.forward_kinematics(joints))
            for mesh in arm.robot.meshes:
                T = Ts[:, mesh.link]
                found.append(np.linalg.norm(T[:, :3, :3] @ mesh.vertices.mean(0) + T[:, :3, 3], axis=-1))
        return float(np.median(np.concatenate(found)))

    def state(
        self,
        joint_positions: Mapping[str, ArrayLike],
        device: Any = "cpu",
        mounts: Mapping[str, Float[np.ndarray, "4 4"]] | None = None,
    ) -> SceneState:
        """State of the scene at given joint positions, with the scene's calibration.

        Args:
            joint_positions: arm name -> values `[*batch, dofs]` in the order of `Robot.joint_names`.
            device: PyTorch device of the tensors; None for NumPy arrays.
            mounts: camera name -> T_mount_world [m], for moving cameras.

        Raises:
            RobotError: an arm has no joint positions, or the wrong number of joint positions.
        """
        values = []
        for arm in self.arms:
            if arm.name not in joint_positions:
                raise RobotError(
                    f"joint positions of arm {arm.name!r} are missing; given: {', '.join(joint_positions)}."
                )
            value = np.asarray(joint_positions[arm.name]).astype(np.float32)
            if value.shape[-1] != len(arm.robot.joint_names):
                raise RobotError(
                    f"arm {arm.name!r} has {len(arm.robot.joint_names)} degrees of freedom "
                    f"({', '.join(arm.robot.joint_names)}) but {value.shape[-1]} joint positions were given."
                )
            values.append(value)
        batch = values[0].shape[:-1]

        def constant(array: np.ndarray) -> np.ndarray:
            return np.broadcast_to(array.astype(np.float32), (*batch, *array.shape)).copy()

        state = SceneState(
            tuple(values),
            constant(np.stack([arm.T_world_base for arm in self.arms])),
            constant(np.stack([camera.T_camera_world for camera in self.cameras])),
            constant(np.array([camera.intrinsics for camera in self.cameras])),
            constant(np.stack([(mounts or {}).get(camera.name, np.eye(4)) for camera in self.cameras])),
        )
        return state if device is None else state.to(device)
