"""Points that a person has found in images, and how far a scene's arms are from them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...errors import SettingsError
from ...model.keypoints import Landmark, LandmarkKind, landmarks, link_transforms
from ...model.scene import Scene

NEAREST = 1e-3
"""[m] Depths below this count as this, so that what is behind the camera is far off instead of undefined."""


@dataclass(frozen=True)
class ImagePoint:
    """A landmark of an arm, and where a person has found it."""

    frame: int
    """Position in the sequence, from 0."""
    camera: str
    arm: str
    landmark: str
    """Its name, as in `model.landmarks.landmarks`."""
    pixel: tuple[float, float]
    """Column and row in the undistorted image, from the upper left corner [px]."""


@dataclass(frozen=True, eq=False)
class View:
    """All points of one arm in one camera, with what the joints say where they are in the arm's base frame."""

    camera: int
    """Index into the scene's cameras."""
    arm: int
    rows: tuple[int, ...]
    """Which of the given points these are."""
    frames: tuple[int, ...]
    landmarks: tuple[Landmark, ...]
    starts: Float[np.ndarray, "points 3"]
    """The point itself, or one end of the axis [m]."""
    ends: Float[np.ndarray, "points 3"]
    """The same, or the other end of the axis [m]."""
    pixels: Float[np.ndarray, "points 2"]

    @property
    def has_edges(self) -> bool:
        """Whether some are edges of a shaft."""
        return any(landmark.kind is LandmarkKind.EDGE for landmark in self.landmarks)

    @property
    def is_point(self) -> np.ndarray:
        """Which of them are points instead of lines [points]."""
        return np.array([landmark.kind is LandmarkKind.POINT for landmark in self.landmarks])

    def distances(
        self, T_camera_base: Float[np.ndarray, "4 4"], intrinsics: Float[np.ndarray, "4"], side: int = 0
    ) -> Float[np.ndarray, "points 2"]:
        """How far the landmarks are from where they were found [px]; of lines, the second number is 0.

        Args:
            T_camera_base: pose of the arm.
            intrinsics: fx, fy, cx, cy [px].
            side: of the shaft that all its edges were found on, 1 or -1; 0 takes the nearer side for each.
        """
        starts = self.starts @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
        ends = self.ends @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
        seen = intrinsics[:2] * starts[:, :2] / np.maximum(starts[:, 2:], NEAREST) + intrinsics[2:]
        found = seen - self.pixels
        for row, landmark in enumerate(self.landmarks):
            if landmark.kind is not LandmarkKind.POINT:
                distance = _line_distance(starts[row], ends[row], self.pixels[row], intrinsics, landmark, side)
                found[row] = distance, 0.0
        return found


def views_of(
    scene: Scene, measured: Mapping[str, Float[np.ndarray, "frames dofs"]], points: Sequence[ImagePoint]
) -> list[View]:
    """Points by camera and arm, in the scene's order.

    Args:
        scene: arms and cameras.
        measured: arm -> joint positions of all frames [rad, m].
        points: what a person has found.

    Raises:
        SettingsError: a point names a frame or a landmark that does not exist, or lies at no place.
        RobotError: a point names an arm or a camera that does not exist.
    """
    grouped: dict[tuple[int, int], list[int]] = {}
    for row, point in enumerate(points):
        camera, arm = scene.cameras.index(scene.camera(point.camera)), scene.arms.index(scene.arm(point.arm))
        frames = len(measured[point.arm])
        if not 0 <= point.frame < frames:
            raise SettingsError(f"there is no frame {point.frame}; frames are 0 to {frames - 1}.")
        if not np.isfinite(point.pixel).all():
            raise SettingsError(f"the {point.landmark} in frame {point.frame} is at {point.pixel}. Give two numbers.")
        grouped.setdefault((camera, arm), []).append(row)
    return [_view(scene, measured, points, camera, arm, tuple(rows)) for (camera, arm), rows in sorted(grouped.items())]


def _view(
    scene: Scene, measured: Mapping[str, np.ndarray], points: Sequence[ImagePoint], camera: int, arm: int, rows
) -> View:
    entry = scene.arms[arm]
    known = landmarks(entry)
    chosen = [points[row] for row in rows]
    for point in chosen:
        if point.landmark not in known:
            raise SettingsError(f"{entry.name} has no {point.landmark!r}. Its landmarks are: {', '.join(known)}.")
    Ts = link_transforms(entry, np.asarray(measured[entry.name])[[point.frame for point in chosen]])
    ends = [known[point.landmark].positions(T) for point, T in zip(chosen, Ts, strict=True)]
    return View(
        camera=camera,
        arm=arm,
        rows=rows,
        frames=tuple(point.frame for point in chosen),
        landmarks=tuple(known[point.landmark] for point in chosen),
        starts=np.stack([each[0] for each in ends]),
        ends=np.stack([each[-1] for each in ends]),
        pixels=np.array([point.pixel for point in chosen], np.float64),
    )


def _line_distance(
    start: np.ndarray, end: np.ndarray, pixel: np.ndarray, intrinsics: np.ndarray, landmark: Landmark, side: int
) -> float:
    """From the ray through a pixel to a cylinder's axis, less its radius [px at the depth where they are closest]."""
    ray = np.array([*((pixel - intrinsics[2:]) / intrinsics[:2]), 1.0])
    ray /= np.linalg.norm(ray)
    axis = (end - start) / np.linalg.norm(end - start)
    across = np.cross(ray, axis)
    length = max(float(np.linalg.norm(across)), 1e-9)
    # The place on the axis that is closest to the ray, which begins at the origin.
    along = float(np.dot(np.cross(ray, start), across)) / length**2
    depth = max(float((start - along * axis)[2]), NEAREST)
    away = float(start @ across) / length
    if landmark.kind is LandmarkKind.EDGE:
        away = (side * away if side else abs(away)) - landmark.radius
    return away * float(intrinsics[:2].mean()) / depth
