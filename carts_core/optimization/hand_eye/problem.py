"""Hand-eye calibration from points as a least-squares problem, initialized by perspective-n-point."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ...errors import SettingsError
from ...model.camera import HALF_PIXEL, opencv_matrix
from ...model.keypoints import Landmark, LandmarkKind, landmarks
from ...model.scene import Scene
from ...settings.ranges import Range, Ranged
from ...wording import counted


@dataclass(frozen=True)
class HandEyeSettings(Ranged):
    """Free parameters of hand-eye calibration, and the noise of clicked points."""

    pixel_error: Annotated[float, Range(0.05, 100, "px")] = 2.0
    """Expected error of a point [px]."""
    focal_length: bool = False
    """Also estimate the focal lengths of all cameras that have points."""
    free_cameras: tuple[str, ...] = ()
    """Cameras whose pose relative to the other cameras is unknown."""


NEAREST = 1e-3
"""Minimum depth in projections [m]; points behind the camera are projected at this depth."""


@dataclass(frozen=True)
class ImagePoint:
    """A landmark of an arm clicked in an image."""

    frame: int
    """Frame index in the sequence, from 0."""
    camera: str
    arm: str
    landmark: str
    """Landmark name, as in `model.keypoints.landmarks`."""
    pixel: tuple[float, float]
    """Column and row in the undistorted image, from the upper left corner [px]."""


@dataclass(frozen=True, eq=False)
class View:
    """All points of one arm in one camera, with landmark positions in the base frame by forward kinematics."""

    camera: int
    """Index into the scene's cameras."""
    arm: int
    rows: tuple[int, ...]
    """Indices of the given points."""
    frames: tuple[int, ...]
    landmarks: tuple[Landmark, ...]
    starts: Float[np.ndarray, "points 3"]
    """Position of a point landmark, or one end of an axis [m]."""
    ends: Float[np.ndarray, "points 3"]
    """Position of a point landmark, or the other end of an axis [m]."""
    pixels: Float[np.ndarray, "points 2"]

    @cached_property
    def is_point(self) -> np.ndarray:
        """Mask of the point landmarks, as opposed to lines [points]."""
        return np.array([landmark.kind is LandmarkKind.POINT for landmark in self.landmarks])

    @property
    def points(self) -> int:
        """Number of point landmarks."""
        return int(self.is_point.sum())

    @cached_property
    def _radii(self) -> np.ndarray:
        """Radius of the shaft for edges [m], NaN for axes [lines]."""
        lines = (landmark for landmark in self.landmarks if landmark.kind is not LandmarkKind.POINT)
        return np.array([line.radius if line.kind is LandmarkKind.EDGE else np.nan for line in lines])

    def distances(
        self, T_camera_base: Float[np.ndarray, "4 4"], intrinsics: Float[np.ndarray, "4"], side: int = 0
    ) -> Float[np.ndarray, "points 2"]:
        """Distances in u and v of the landmarks from their clicked points [px]; for lines, the distance and 0.

        Args:
            intrinsics: fx, fy, cx, cy [px].
            side: side of the shaft on which all its edge points lie, 1 or -1; 0 selects the nearer side for each.
        """
        starts = self.starts @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
        ends = self.ends @ T_camera_base[:3, :3].T + T_camera_base[:3, 3]
        seen = intrinsics[:2] * starts[:, :2] / np.maximum(starts[:, 2:], NEAREST) + intrinsics[2:]
        found = seen - self.pixels
        lines = ~self.is_point
        if lines.any():
            found[lines] = 0.0
            found[lines, 0] = self._line_distances(starts[lines], ends[lines], self.pixels[lines], intrinsics, side)
        return found

    def _line_distances(
        self, starts: np.ndarray, ends: np.ndarray, pixels: np.ndarray, intrinsics: np.ndarray, side: int
    ) -> np.ndarray:
        """Distances between the rays through pixels and the axes of cylinders, for edges minus the radius [px at the
        depth of the nearest point]."""
        rays = np.column_stack([(pixels - intrinsics[2:]) / intrinsics[:2], np.ones(len(pixels))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        axes = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
        across = np.cross(rays, axes)
        lengths = np.maximum(np.linalg.norm(across, axis=1), 1e-9)
        # Points on the axes nearest to the rays from the origin.
        dot = partial(np.einsum, "ij,ij->i")
        along = (dot(starts, axes) - dot(rays, axes) * dot(starts, rays)) / lengths**2
        depths = np.maximum(starts[:, 2] - along * axes[:, 2], NEAREST)
        away = dot(starts, across) / lengths
        edges = np.isfinite(self._radii)
        away[edges] = (side * away[edges] if side else np.abs(away[edges])) - self._radii[edges]
        return away * intrinsics[:2].mean() / depths


def views_of(
    scene: Scene, measured: Mapping[str, Float[np.ndarray, "frames dofs"]], points: Sequence[ImagePoint]
) -> list[View]:
    """Group points by camera and arm, in the scene's order; `measured` are the joint positions of all frames [rad, m].

    Raises:
        SettingsError: a point names a frame or a landmark that does not exist, or has no finite position.
        RobotError: a point names an arm or a camera that does not exist.
    """
    grouped: dict[tuple[int, int], list[int]] = {}
    for row, point in enumerate(points):
        camera, arm = scene.cameras.index(scene.camera(point.camera)), scene.arms.index(scene.arm(point.arm))
        frames = len(measured[point.arm])
        if not 0 <= point.frame < frames:
            raise SettingsError(f"there is no frame {point.frame}; frames are 0 to {frames - 1}.")
        if not np.isfinite(point.pixel).all():
            raise SettingsError(
                f"the {point.landmark} in frame {point.frame} is at {point.pixel}. Give two finite numbers [px]."
            )
        grouped.setdefault((camera, arm), []).append(row)
    views = []
    for (camera, arm), rows in sorted(grouped.items()):
        entry, chosen = scene.arms[arm], [points[row] for row in rows]
        known = landmarks(entry)
        for point in chosen:
            if point.landmark not in known:
                raise SettingsError(f"{entry.name} has no {point.landmark!r}. Its landmarks are: {', '.join(known)}.")
        frames = tuple(point.frame for point in chosen)
        found = tuple(known[point.landmark] for point in chosen)
        Ts = entry.robot.forward_kinematics(np.asarray(measured[entry.name])[list(frames)])
        ends = [landmark.positions(T) for landmark, T in zip(found, Ts, strict=True)]
        starts, last = (np.stack([each[place] for each in ends]) for place in (0, -1))
        pixels = np.array([point.pixel for point in chosen], np.float64)
        views.append(View(camera, arm, tuple(rows), frames, found, starts, last, pixels))
    return views


MIN_POINTS = 4
"""Minimum number of points; three points allow up to four poses."""
_RANDOM_SUBSETS = 40
_KEPT = 4
"""Number of best poses that are refined."""


def poses_of(
    view: View, intrinsics: Float[np.ndarray, "4"], pixel_error: float
) -> list[tuple[float, Float[np.ndarray, "4 4"]]]:
    """Candidate poses T_camera_base with their costs, best first.

    Perspective-n-point (SQPnP, EPnP) is applied to all points, to all points except those of one frame, to all except
    one, and to random subsets, so that some subset is free of outliers. The cost of a pose is the robust cost of all
    points.

    Args:
        intrinsics: fx, fy, cx, cy [px].
        pixel_error: expected error of a point [px].
    """
    found: list[tuple[float, np.ndarray]] = []
    for rows in _subsets(view):
        for T in _perspective(view, rows, intrinsics):
            if (T[2, :3] @ view.starts[view.is_point].T + T[2, 3] > 0).all():
                # Cauchy loss of the distances, in units of the expected error.
                squared = ((view.distances(T, intrinsics) / pixel_error) ** 2).sum(-1)
                found.append((float(np.log1p(squared / 4.0).sum()), T))
    found.sort(key=lambda entry: entry[0])
    return found[:_KEPT]


def _subsets(view: View) -> Iterator[Bool[np.ndarray, " points"]]:
    """Subsets of points: all points, all except a few, and random subsets."""
    points = view.is_point
    yield points
    frames = np.array(view.frames)
    for frame in dict.fromkeys(view.frames):
        yield points & (frames != frame)
    for row in np.flatnonzero(points):
        yield points & (np.arange(len(points)) != row)
    random = np.random.default_rng(0)
    count = int(points.sum())
    for _ in range(_RANDOM_SUBSETS if count > MIN_POINTS else 0):
        chosen = np.zeros(len(points), bool)
        chosen[random.choice(np.flatnonzero(points), min(count, MIN_POINTS + 1), replace=False)] = True
        yield chosen


def _perspective(view: View, rows: np.ndarray, intrinsics: np.ndarray) -> Iterator[np.ndarray]:
    if rows.sum() < MIN_POINTS:
        return
    K = opencv_matrix(intrinsics)
    pixels = view.pixels[rows] - HALF_PIXEL
    for method in (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP):
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                np.ascontiguousarray(view.starts[rows]), pixels, K, None, flags=method
            )
        except cv2.error:
            # Coincident or collinear points do not determine a pose.
            continue
        for rotation, translation in zip(rotations, translations, strict=True):
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
            if np.isfinite(T).all():
                yield T


class HandEyeProblem:
    """Least-squares problem in small rotations and translations of arms and cameras about an initial estimate.

    Attributes:
        scene: arms and cameras as given.
        settings: free parameters.
        views: the points that are used, by camera and arm.
        missing: (camera, arm) -> number of points missing for a pose.
        focal: cameras with free focal lengths, whose logarithms are the last unknowns.
        middles: arm -> centroid of its points in its base frame [m].
        origin: zeros, the initial estimate.
    """

    def __init__(
        self, scene: Scene, views: list[View], free: set[int], settings: HandEyeSettings, focal_factor: float
    ) -> None:
        self.scene, self.settings = scene, settings
        self._intrinsics = np.array([camera.intrinsics for camera in scene.cameras])
        self._intrinsics[:, :2] *= focal_factor
        self._T_world_base: dict[int, np.ndarray] = {}
        self._T_camera_world = {index: camera.T_camera_world for index, camera in enumerate(scene.cameras)}
        self.missing: dict[tuple[int, int], int] = {}
        self._find_beginning(views, free)
        self.views = [
            view for view in views if view.arm in self._T_world_base and (view.camera, view.arm) not in self.missing
        ]
        if not self.views:
            parts = [
                f"{scene.arms[arm].name} needs {counted(more, 'more point')} in {scene.cameras[camera].name}"
                for (camera, arm), more in self.missing.items()
            ]
            raise SettingsError(
                f"{'; '.join(parts)}. Points on the shaft are not counted. Click tip and wrist in several frames."
                if parts
                else "there are no points. Click tip, wrist and shaft of an arm in 3 to 6 frames."
            )
        self._arms = list(self._T_world_base)
        self._cameras = [view.camera for view in self.views]
        self._free = sorted(free & set(self._cameras) - {self._anchor})
        self.focal = sorted(set(self._cameras)) if settings.focal_length else []
        self.middles = {
            arm: np.concatenate([view.starts[view.is_point] for view in self.views if view.arm == arm]).mean(0)
            for arm in self._arms
        }
        self.origin = np.zeros(6 * len(self._arms) + 6 * len(self._free) + len(self.focal))
        known = sum(2 if point else 1 for view in self.views for point in view.is_point)
        if known < len(self.origin):
            raise SettingsError(
                f"{counted(len(self.origin), 'unknown')} cannot be determined from {known} measurements. Click more "
                "points, also in other frames, or fix the focal length."
            )

    def _find_beginning(self, views: list[View], free: set[int]) -> None:
        """Initialize base frames from the view with the most points, then poses of free cameras."""
        self._anchor = _anchor(views, free)
        unknown = free - {self._anchor}
        remaining = list(views)
        while remaining:
            # Known cameras come first, since base frames in their view determine the poses of free cameras; then known
            # arms, since a base frame must not be computed from an unknown camera pose.
            keys = [(view.camera in unknown, view.arm not in self._T_world_base, -view.points) for view in remaining]
            view = remaining.pop(keys.index(min(keys)))
            count = view.points
            known = view.arm in self._T_world_base
            if (known and view.camera not in unknown) or count < MIN_POINTS:
                if count < MIN_POINTS and (not known or view.camera in unknown):
                    self.missing[view.camera, view.arm] = MIN_POINTS - count
                continue
            poses = poses_of(view, self._intrinsics[view.camera], self.settings.pixel_error)
            if known:
                # Cameras of one endoscope have similar poses, so the anchor camera's pose is another initial value.
                beside = self._T_camera_world[self._anchor] @ self._T_world_base[view.arm]
                poses.append((0.0, beside))
            if not poses:
                raise SettingsError(
                    f"no pose of {self.scene.arms[view.arm].name} in {self.scene.cameras[view.camera].name} can be "
                    "computed from its points, which coincide or are collinear. Click other points, in other frames."
                )
            T_camera_base = min((self._refined(view, T) for _, T in poses), key=lambda entry: entry[0])[1]
            if not known:
                self._T_world_base[view.arm] = np.linalg.inv(self._T_camera_world[view.camera]) @ T_camera_base
            elif view.camera in unknown:
                self._T_camera_world[view.camera] = T_camera_base @ np.linalg.inv(self._T_world_base[view.arm])
                unknown.discard(view.camera)
        for key in [key for key in self.missing if key[1] in self._T_world_base and key[0] not in unknown]:
            # Another camera or arm determines the pose, so these points are used as well.
            del self.missing[key]

    def _refined(self, view: View, T: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and refined pose of a single view, from an initial pose."""
        middle = view.starts[view.is_point].mean(0)
        scale = self.settings.pixel_error

        def residuals(step: np.ndarray) -> np.ndarray:
            return (view.distances(apply_step(T, step, middle), self._intrinsics[view.camera]) / scale).ravel()

        fit = least_squares(residuals, np.zeros(6), loss="cauchy", f_scale=2.0, x_scale="jac", max_nfev=50)
        return float(fit.cost), apply_step(T, fit.x, middle)

    def poses(self, values: np.ndarray) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], np.ndarray]:
        """T_world_base by arm, T_camera_world by camera, intrinsics."""
        steps = values[: 6 * (len(self._arms) + len(self._free))].reshape(-1, 6)
        bases = {
            arm: apply_step(self._T_world_base[arm], step, self.middles[arm])
            for arm, step in zip(self._arms, steps, strict=False)
        }
        cameras = dict(self._T_camera_world)
        for camera, step in zip(self._free, steps[len(self._arms) :], strict=True):
            arm = next(view.arm for view in self.views if view.camera == camera)
            cameras[camera] = apply_step(
                cameras[camera], step, transform_point(self._T_world_base[arm], self.middles[arm])
            )
        intrinsics = self._intrinsics.copy()
        for camera, change in zip(self.focal, values[6 * len(steps) :], strict=True):
            intrinsics[camera, :2] *= np.exp(change)
        return bases, cameras, intrinsics

    def distances(self, values: np.ndarray, sides: Sequence[int] | None = None) -> list[np.ndarray]:
        """Distances of the landmarks of each view from their clicked points [px].

        Args:
            sides: side of the shaft with the edges of each view; the nearer one by default.
        """
        bases, cameras, intrinsics = self.poses(values)
        return [
            view.distances(cameras[view.camera] @ bases[view.arm], intrinsics[view.camera], side)
            for view, side in zip(self.views, sides or [0] * len(self.views), strict=True)
        ]

    def residuals(self, values: np.ndarray, sides: Sequence[int] | None = None) -> np.ndarray:
        """Distances divided by their expected error [1]."""
        return np.concatenate(self.distances(values, sides)).ravel() / self.settings.pixel_error


def apply_step(T: np.ndarray, step: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Rotate T about the transformed point `middle` by step[:3] [rad], and translate it by step[3:] [m]."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    place = transform_point(T, middle)
    moved = np.eye(4)
    moved[:3, :3] = turn @ T[:3, :3]
    moved[:3, 3] = turn @ (T[:3, 3] - place) + place + step[3:]
    return moved


def transform_point(T: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Transform a point by T."""
    return T[:3, :3] @ point + T[:3, 3]


def _anchor(views: list[View], free: set[int]) -> int:
    """Index of the camera whose pose is fixed: the known camera with the most points, else a free camera; -1 if no
    camera has enough points."""
    points: dict[int, int] = {}
    for view in views:
        if view.points >= MIN_POINTS:
            points[view.camera] = points.get(view.camera, 0) + view.points
    return max(points, key=lambda camera: (camera not in free, points[camera], -camera), default=-1)
