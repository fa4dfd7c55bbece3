"""The differentiable renderer: scene and state in, image and silhouette out (f_DR of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..scene import Scene, SceneState
from .geometry import SceneGeometry, link_transforms
from .motion import carry_motion
from .shading import phong, rotate, visible_points
from .visibility_numba import visibility_numba
from .visibility_torch import visibility_torch


@dataclass(frozen=True)
class Rendering:
    """Images of all cameras of all hypotheses."""

    image: Float[Tensor, "*batch cameras 3 height width"]
    """Linear RGB in [0, 1], black where no robot is (Î of the paper)."""
    silhouette: Float[Tensor, "*batch cameras height width"]
    """1 where a robot is, 0 elsewhere (Ŝ of the paper); its gradient is that of the boundary."""
    arm_ids: Int[Tensor, "*batch cameras height width"]
    """Index of the visible arm, -1 for background."""
    depth: Float[Tensor, "*batch cameras height width"]
    """Depth of the visible surface [m], 0 for background; without gradient."""

    def arm_masks(self, arms: int) -> Bool[Tensor, "*batch cameras {arms} height width"]:
        """The visible part of each arm."""
        index = torch.arange(arms, device=self.arm_ids.device)[:, None, None]
        return self.arm_ids[..., None, :, :] == index


class Renderer:
    """Renders the arms of a scene into its cameras.

    Args:
        scene: arms, cameras and light.
        width, height: size of the rendered images [px], by default that of the first camera. The intrinsics of a
            state are those of the camera's own size and are scaled.
        cameras: names of the cameras to render, all by default.
        device: "cpu" (compiled visibility kernel) or a CUDA device (torch visibility).
    """

    def __init__(
        self,
        scene: Scene,
        *,
        width: int | None = None,
        height: int | None = None,
        cameras: Sequence[str] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.scene = scene.with_cameras(cameras)
        self.width = width or self.scene.cameras[0].width
        self.height = height or self.scene.cameras[0].height
        self.device = torch.device(device)
        self.geometry = SceneGeometry.of(scene, device)
        self._faces = self.geometry.faces.cpu().numpy()
        scale = [[self.width / camera.width, self.height / camera.height] * 2 for camera in self.scene.cameras]
        self._scale = torch.tensor(scale, dtype=torch.float32, device=device)
        self._indices = [scene.cameras.index(camera) for camera in self.scene.cameras]

    def __call__(self, state: SceneState) -> Rendering:
        """Render; gradients reach every tensor of the state."""
        Ts, intrinsics = self._views(state)
        batch = Ts.shape[:-4]
        views_T, views_K = Ts.flatten(0, -4), intrinsics.flatten(0, -2)
        face_ids, depth = self._visibility(views_T.detach(), views_K.detach())
        points = visible_points(self.geometry, face_ids, views_T.detach(), views_K.detach())
        T = views_T[points.view, self.geometry.face_links[points.face]]
        point = rotate(T[:, :3, :3], points.point_link) + T[:, :3, 3]
        normal = rotate(T[:, :3, :3], points.normal_link)
        color = phong(self.geometry.face_colors[points.face], point, normal, self.scene.light)
        values = torch.cat([color, torch.ones_like(color[:, :1])], -1)
        dense = values.new_zeros(face_ids.numel(), 4).index_copy(0, points.pixel, values).view(*face_ids.shape, 4)
        if torch.is_grad_enabled() and (T.requires_grad or views_K.requires_grad):
            K = views_K[points.view]
            position = K[:, :2] * point[:, :2] / point[:, 2:] + K[:, 2:]
            inverse_depth = torch.where(face_ids >= 0, 1.0 / depth, 0.0)
            dense = carry_motion(dense, position, points.pixel, inverse_depth)
        shape = (*batch, len(self._indices), self.height, self.width)
        image = dense.view(*shape, 4).movedim(-1, -3)
        arm_ids = torch.where(face_ids >= 0, self.geometry.face_arms[face_ids.long()], -1)
        return Rendering(image[..., :3, :, :], image[..., 3, :, :], arm_ids.view(shape), depth.view(shape))

    @torch.no_grad()
    def segment(self, state: SceneState) -> Int[np.ndarray, "*batch cameras height width"]:
        """Index of the visible arm per pixel, -1 for background; visibility alone, so faster than a rendering."""
        Ts, intrinsics = self._views(state)
        face_ids, _ = self._visibility(Ts.flatten(0, -4), intrinsics.flatten(0, -2))
        arm_ids = torch.where(face_ids >= 0, self.geometry.face_arms[face_ids.long()], -1)
        return arm_ids.view(*Ts.shape[:-3], self.height, self.width).cpu().numpy()

    def _views(self, state: SceneState) -> tuple[Tensor, Tensor]:
        """Ts_camera_link [*batch, cameras, links, 4, 4] and scaled intrinsics of the rendered cameras."""
        if state.T_camera_world.shape[-3] != len(self._indices):
            # A state of the whole scene is cut down to the cameras that are rendered.
            state = SceneState(
                state.joint_positions,
                state.T_world_base,
                state.T_camera_world[..., self._indices, :, :],
                state.intrinsics[..., self._indices, :],
            )
        return link_transforms(self.scene, state), state.intrinsics * self._scale

    @torch.no_grad()
    def _visibility(self, views_T: Tensor, views_K: Tensor) -> tuple[Tensor, Tensor]:
        """Visible triangle and depth [views, height, width]."""
        geometry = self.geometry
        ids, depths = [], []
        for T_camera_link, intrinsics in zip(views_T, views_K, strict=True):
            T = T_camera_link[geometry.vertex_links]
            vertices = rotate(T[:, :3, :3], geometry.vertices) + T[:, :3, 3]
            if self.device.type == "cpu":
                face_ids, depth = visibility_numba(
                    vertices.numpy(), self._faces, tuple(intrinsics.tolist()), self.width, self.height
                )
                face_ids, depth = torch.from_numpy(face_ids), torch.from_numpy(depth)
            else:
                face_ids, depth = visibility_torch(vertices, geometry.faces, intrinsics, self.width, self.height)
            ids.append(face_ids)
            depths.append(depth)
        return torch.stack(ids), torch.stack(depths)
