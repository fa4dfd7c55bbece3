"""What each pixel of a real frame sees, as far as measured kinematics and a mask tell."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from ...model.scene import Scene
from ...rendering import Renderer
from ...rendering.geometry import link_transforms
from ...rendering.points import visible_points
from ...settings import EndoscopeConfig
from ..synthesis.path_tracer import Surface

_CLEARANCE = 0.005
"""Between the deepest tip and the plane behind it [m]."""
DISTANCE = EndoscopeConfig().distance
"""From the camera to the plane in the scaled world [m]: that for which blood and smoke are made."""


class RealSurface:
    """Instruments before a plane that is parallel to the image.

    Everything is in a world like the synthetic one: the plane is z = 0, and the camera looks straight down at its
    origin. The world is scaled such that it does so from the synthetic camera's distance; otherwise a camera that
    stands farther away would see more smoke and smaller drops.

    Args:
        scene: with one camera.
        recording: measured joint positions of frames of the recording, arm -> [dofs]; they place the plane.
    """

    def __init__(self, scene: Scene, recording: Sequence[Mapping[str, np.ndarray]]) -> None:
        self._scene = scene
        self._renderer = Renderer(scene)
        depths = [float(self._rendered(measured).depth.max()) for measured in recording]
        self._scale = DISTANCE / (max(*depths, 0.02) + _CLEARANCE)
        self._T_world_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        self._T_world_camera[2, 3] = DISTANCE
        self.lens: np.ndarray = self._T_world_camera[:3, 3]
        """The lens, in the world."""
        camera = scene.cameras[0]
        fx, fy, cx, cy = camera.intrinsics
        rows, columns = np.indices((camera.height, camera.width)) + 0.5
        self._rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], -1)

    def Ts_world_link(self, measured: Mapping[str, np.ndarray] | None) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The place of every link; none without joint positions. Links are scaled as the world is."""
        if measured is None:
            return {}
        Ts_camera_link = link_transforms(self._scene, self._scene.state(measured))[0].double().numpy()
        Ts_camera_link[:, :3, 3] *= self._scale
        return dict(enumerate(self._T_world_camera @ Ts_camera_link))

    def of(self, mask: Bool[np.ndarray, "h w"], measured: Mapping[str, np.ndarray] | None) -> Surface:
        """The surface of a frame: in the mask that of the nearest pixel of the arms as measured, elsewhere the plane.

        Args:
            mask: the instruments' pixels.
            measured: arm -> joint positions [rad, m]; None where there are no arms.
        """
        depth = np.full(mask.shape, DISTANCE)
        normal = np.zeros((*mask.shape, 3))
        normal[..., 2] = 1.0
        link = np.full(mask.shape, -1, np.int32)
        if measured is not None and mask.any():
            arm_depth, arm_normal, arm_link = self._arms(measured)
            if (arm_link >= 0).any():
                nearest = distance_transform_edt(arm_link < 0, return_distances=False, return_indices=True)
                place = tuple(axis[mask] for axis in np.asarray(nearest))
                depth[mask], normal[mask], link[mask] = arm_depth[place], arm_normal[place], arm_link[place]
        position = (self._rays * depth[..., None]) @ self._T_world_camera[:3, :3].T + self.lens
        return Surface(position, normal.astype(np.float32), link, depth)

    def _rendered(self, measured: Mapping[str, np.ndarray]):
        with torch.no_grad():
            return self._renderer(self._scene.state(measured))

    def _arms(self, measured: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scaled depth, normal in the world and link of the arms in the image; the link is -1 where there is none."""
        state, geometry = self._scene.state(measured), self._renderer.geometry
        rendering = self._rendered(measured)
        face = rendering.face_ids[0].long()
        link = torch.where(face >= 0, geometry.face_links[face], -1)
        Ts = link_transforms(self._scene, state)
        points = visible_points(geometry, rendering.face_ids, rendering.inverse_depth, Ts, state.intrinsics)
        normal = torch.zeros(link.numel(), 3)
        normal[points.pixel] = points.transformed(Ts)[1].T
        in_world = normal.view(*link.shape, 3).double().numpy() @ self._T_world_camera[:3, :3].T
        return self._scale * rendering.depth[0].double().numpy(), in_world, link.numpy().astype(np.int32)
