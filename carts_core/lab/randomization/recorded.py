"""Arms where a recording has them: its robots, its cameras, its distances."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...recording import Sequence
from .geometry import Intrinsics, RobotGeometry
from .placement import Placement, turned

_FRAMES = 200
"""Frames that joint positions are taken from, spread over the recording."""
_TURN = np.deg2rad(8.0)
"""How far an arm is turned in front of the camera, standard deviation [rad]."""
_SHIFT = 0.06
"""How far it is moved, standard deviation in distances from the camera [1]."""
_JOINTS = 0.12
"""How far joints are moved, standard deviation in parts of their range in the recording, and at least..."""
_LEAST = np.deg2rad(6.0)
"""...so many [rad], and a tenth of that in [m] for sliding joints."""
_ZOOM = 0.12
"""Standard deviation of the logarithm of the focal length [1]."""


class RecordedPlacements:
    """Placements like those of a recording.

    Args:
        path: sequence file.

    Raises:
        SequenceError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        sequence = Sequence.open(path)
        indices = sorted({round(i) for i in np.linspace(0, len(sequence) - 1, min(_FRAMES, len(sequence)))})
        self._arms = {arm.name: arm for arm in sequence.scene.arms}
        self._cameras = sequence.scene.cameras
        self._joints = {name: np.asarray(sequence.measured[name], dtype=float)[indices] for name in self._arms}
        self._names: dict[Path, list[str]] = {}
        for name, arm in self._arms.items():
            self._names.setdefault(arm.robot.urdf, []).append(name)

    def __call__(
        self, rng: np.random.Generator, geometries: tuple[RobotGeometry, ...], size: tuple[int, int], field: int
    ) -> tuple[Intrinsics, list[Placement]]:
        """A camera and a place for each robot, some part of the first of which is in the image.

        Args:
            rng: random numbers.
            geometries: robots of the recording.
            size: width and height of the image [px], a part of the camera's image.
            field: width of the camera's image [px].

        Raises:
            SettingsError: a robot is none of the recording.
        """
        camera = self._cameras[int(rng.integers(len(self._cameras)))]
        zoom = field / camera.width * float(np.exp(rng.normal(0, _ZOOM)))
        fx, fy = camera.intrinsics[0] * zoom, camera.intrinsics[1] * zoom
        taken: list[str] = []
        placements = []
        for geometry in geometries:
            names = self._names.get(geometry.robot.urdf)
            if names is None:
                raise SettingsError(f"robot {geometry.robot.urdf} is none of the recording's. Leave out `robots`.")
            free = [name for name in names if name not in taken] or names
            taken.append(free[int(rng.integers(len(free)))])
            placements.append(self._placement(rng, taken[-1], geometry, camera.T_camera_world))
        seen = _points(geometries[0], placements[0])
        seen = seen[seen[:, 2] > 1e-3]
        if not len(seen):
            return (fx, fy, size[0] / 2, size[1] / 2), placements
        x, y, z = seen[int(rng.integers(len(seen)))]
        # That point comes to lie anywhere in the image.
        u, v = rng.uniform(0.1, 0.9, 2) * size
        return (fx, fy, u - fx * x / z, v - fy * y / z), placements

    def _placement(
        self, rng: np.random.Generator, name: str, geometry: RobotGeometry, T_camera_world: Float[np.ndarray, "4 4"]
    ) -> Placement:
        rows = self._joints[name]
        least = np.where(np.array(geometry.robot.joint_types) == "revolute", _LEAST, 0.1 * _LEAST)
        spread = np.maximum(_JOINTS * np.ptp(rows, axis=0), least)
        low, high = geometry.robot.joint_limits.numpy().T
        joints = np.clip(rows[int(rng.integers(len(rows)))] + rng.normal(0, 1, rows.shape[1]) * spread, low, high)
        T_camera_base = T_camera_world @ self._arms[name].T_world_base
        placement = Placement(joints, T_camera_base)
        ahead = _points(geometry, placement)
        ahead = ahead[ahead[:, 2] > 0]
        distance = float(np.median(ahead[:, 2])) if len(ahead) else 0.1
        pivot = ahead.mean(0) if len(ahead) else np.array([0.0, 0.0, distance])
        turn = np.eye(4)
        turn[:3, :3] = turned(rng.normal(0, _TURN, 3))
        turn[:3, 3] = pivot - turn[:3, :3] @ pivot + rng.normal(0, _SHIFT * distance, 3)
        return Placement(joints, turn @ T_camera_base)


def _points(geometry: RobotGeometry, placement: Placement) -> Float[np.ndarray, "V 3"]:
    """The arm's vertices in the camera's frame [m]."""
    Ts_base_link = geometry.link_transforms(placement.joint_positions)
    return geometry.posed(placement.T_camera_base @ Ts_base_link).vertices.astype(float)
