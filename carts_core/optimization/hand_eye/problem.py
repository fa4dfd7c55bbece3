"""Poses of arms and cameras around a beginning, as a vector that a solver can change."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ...errors import SettingsError
from ...model.scene import Scene
from ...wording import counted
from .points import View
from .settings import HandEyeSettings
from .start import FEWEST_POINTS, poses_of


class HandEyeProblem:
    """Poses of arms and cameras around a beginning, as a vector of small turns and shifts at the middle of points.

    Attributes:
        scene: arms and cameras as given.
        settings: what is free.
        views: the points that are used.
        missing: (camera, arm) -> how many more points are needed for it.
        focal: cameras whose focal length is free; their logarithms are the last unknowns.
        middles: arm -> middle of its points in its base frame [m].
        origin: the vector of the beginning, zeros.
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
            raise SettingsError(_too_few(scene, self.missing))
        self._arms = list(self._T_world_base)
        self._cameras = [view.camera for view in self.views]
        self._free = sorted(free & set(self._cameras) - {self._anchor})
        focal = sorted(set(self._cameras)) if settings.focal_length else []
        self.focal = [camera for camera in focal if sum(each == camera for each in self._cameras)]
        self.middles = self._middle_of_arms()
        self.origin = np.zeros(6 * len(self._arms) + 6 * len(self._free) + len(self.focal))
        known = sum(2 if point else 1 for view in self.views for point in view.is_point)
        if known < len(self.origin):
            raise SettingsError(
                f"{counted(len(self.origin), 'value')} are to be found and the points give {known}. Click more points, "
                "also in other frames, or keep the focal length."
            )

    def _find_beginning(self, views: list[View], free: set[int]) -> None:
        """Base frames by the view with most points, then cameras whose pose is not known."""
        self._anchor = _anchor(views, free)
        unknown = free - {self._anchor}
        # Cameras whose pose is known first: then the others have base frames to be placed by.
        for view in sorted(views, key=lambda view: (view.camera in unknown, -int(view.is_point.sum()))):
            count = int(view.is_point.sum())
            known = view.arm in self._T_world_base
            if (known and view.camera not in unknown) or count < FEWEST_POINTS:
                if count < FEWEST_POINTS and (not known or view.camera in unknown):
                    self.missing[view.camera, view.arm] = FEWEST_POINTS - count
                continue
            poses = poses_of(view, self._intrinsics[view.camera], self.settings.pixel_error)
            if known:
                # Cameras of one endoscope look nearly the same way, so where the first one is, is a beginning as well.
                beside = self._T_camera_world[self._anchor] @ self._T_world_base[view.arm]
                poses.append((0.0, beside))
            if not poses:
                raise SettingsError(
                    f"no pose of {self.scene.arms[view.arm].name} before {self.scene.cameras[view.camera].name} fits "
                    "its points. They lie on each other or on a line: click others, in other frames."
                )
            T_camera_base = min((self._refined(view, T) for _, T in poses), key=lambda entry: entry[0])[1]
            if not known:
                self._T_world_base[view.arm] = np.linalg.inv(self._T_camera_world[view.camera]) @ T_camera_base
            elif view.camera in unknown:
                self._T_camera_world[view.camera] = T_camera_base @ np.linalg.inv(self._T_world_base[view.arm])
                unknown.discard(view.camera)
        for key in [key for key in self.missing if key[1] in self._T_world_base and key[0] not in unknown]:
            # Another camera, or another arm in this one, has settled it: these points count as well.
            del self.missing[key]

    def _refined(self, view: View, T: np.ndarray) -> tuple[float, np.ndarray]:
        """A single view's pose of lowest cost near a beginning."""
        middle = view.starts[view.is_point].mean(0)
        scale = self.settings.pixel_error

        def residuals(step: np.ndarray) -> np.ndarray:
            return (view.distances(moved(T, step, middle), self._intrinsics[view.camera]) / scale).ravel()

        fit = least_squares(residuals, np.zeros(6), loss="cauchy", f_scale=2.0, x_scale="jac", max_nfev=50)
        return float(fit.cost), moved(T, fit.x, middle)

    def _middle_of_arms(self) -> dict[int, np.ndarray]:
        """Arm -> middle of its points in its base frame [m]."""
        return {
            arm: np.concatenate([view.starts[view.is_point] for view in self.views if view.arm == arm]).mean(0)
            for arm in self._arms
        }

    def poses(self, values: np.ndarray) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], np.ndarray]:
        """T_world_base by arm, T_camera_world by camera, intrinsics."""
        steps = values[: 6 * (len(self._arms) + len(self._free))].reshape(-1, 6)
        bases = {
            arm: moved(self._T_world_base[arm], step, self.middles[arm])
            for arm, step in zip(self._arms, steps, strict=False)
        }
        cameras = dict(self._T_camera_world)
        for camera, step in zip(self._free, steps[len(self._arms) :], strict=True):
            arm = next(view.arm for view in self.views if view.camera == camera)
            cameras[camera] = moved(cameras[camera], step, place_of(self._T_world_base[arm], self.middles[arm]))
        intrinsics = self._intrinsics.copy()
        for camera, change in zip(self.focal, values[6 * len(steps) :], strict=True):
            intrinsics[camera, :2] *= np.exp(change)
        return bases, cameras, intrinsics

    def distances(self, values: np.ndarray, sides: Sequence[int] | None = None) -> list[np.ndarray]:
        """How far the landmarks of each view are from where they were found [px].

        Args:
            values: of the unknowns.
            sides: of each view, the side of the shaft that its edges are on; the nearer one by default.
        """
        bases, cameras, intrinsics = self.poses(values)
        return [
            view.distances(cameras[view.camera] @ bases[view.arm], intrinsics[view.camera], side)
            for view, side in zip(self.views, sides or [0] * len(self.views), strict=True)
        ]

    def residuals(self, values: np.ndarray, sides: Sequence[int] | None = None) -> np.ndarray:
        """Distances over their expected error [1]."""
        return np.concatenate(self.distances(values, sides)).ravel() / self.settings.pixel_error


def moved(T: np.ndarray, step: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """T turned about where it puts `middle`, by step[:3] [rad], and shifted by step[3:] [m]."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    place = place_of(T, middle)
    moved = np.eye(4)
    moved[:3, :3] = turn @ T[:3, :3]
    moved[:3, 3] = turn @ (T[:3, 3] - place) + place + step[3:]
    return moved


def place_of(T: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Where T puts a point."""
    return T[:3, :3] @ point + T[:3, 3]


def _anchor(views: list[View], free: set[int]) -> int:
    """The camera that keeps its pose: a known one with most points, one of the free ones if none is known, -1 if no
    camera has enough."""
    points: dict[int, int] = {}
    for view in views:
        if (count := int(view.is_point.sum())) >= FEWEST_POINTS:
            points[view.camera] = points.get(view.camera, 0) + count
    return max(points, key=lambda camera: (camera not in free, points[camera], -camera), default=-1)


def _too_few(scene: Scene, missing: Mapping[tuple[int, int], int]) -> str:
    if not missing:
        return "there is no point. Click tip, wrist and shaft of an arm in 3 to 6 frames."
    parts = [
        f"{scene.arms[arm].name} needs {counted(more, 'more point')} in {scene.cameras[camera].name}"
        for (camera, arm), more in missing.items()
    ]
    return f"{'; '.join(parts)}. Edges of the shaft do not count as points; click tip and wrist, in several frames."
