"""The differentiable renderer: scene and state in, image and silhouette out (f_DR of the paper)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..scene import Scene, SceneState
from .geometry import SceneGeometry, link_transforms
from .shading import VisiblePoints, intersect, phong, pixel_rays, rotate
from .silhouette import boundary_pairs, boundary_term
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
        points = VisiblePoints.of(face_ids)
        Ts_camera_link = views_T[points.view, self.geometry.face_links[points.face]]
        rays = pixel_rays(points, views_K)
        points_link = intersect(self.geometry, points, Ts_camera_link, rays)
        color = phong(self.geometry, points, Ts_camera_link, points_link, self.scene.light)
        pixel = (points.view * self.height + points.y) * self.width + points.x
        values = torch.cat([color, torch.ones_like(color[:, :1])], -1)
        flat = values.new_zeros(face_ids.numel(), 4).index_copy(0, pixel, values)
        if torch.is_grad_enabled() and (views_T.requires_grad or views_K.requires_grad):
            flat = self._with_boundary(flat, face_ids, depth, points, pixel, Ts_camera_link, points_link, views_K)
        shape = (*batch, len(self._indices), self.height, self.width)
        image = flat.view(*shape, 4).movedim(-1, -3)
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

    def _with_boundary(
        self,
        flat: Tensor,
        face_ids: Tensor,
        depth: Tensor,
        points: VisiblePoints,
        pixel: Tensor,
        Ts_camera_link: Tensor,
        points_link: Tensor,
        views_K: Tensor,
    ) -> Tensor:
        """The flattened image with the gradient of its occlusion boundaries added."""
        with torch.no_grad():
            slope = self._slope(depth, points, pixel, Ts_camera_link, views_K)
            pairs = boundary_pairs(face_ids, depth, slope, views_K[:, :2])
            row = torch.zeros(face_ids.numel(), dtype=torch.int64, device=flat.device)
            row[pixel] = torch.arange(len(pixel), device=flat.device)
            near = row[pairs.near]
        # The surface point stays where it is on its link, and moves in the image with the link and the camera.
        T = Ts_camera_link[near]
        point = rotate(T[:, :3, :3], points_link[near].detach()) + T[:, :3, 3]
        intrinsics = views_K[points.view[near]]
        position = intrinsics[:, :2] * point[:, :2] / point[:, 2:] + intrinsics[:, 2:]
        term = boundary_term(pairs, flat, position)
        return flat.index_add(0, pairs.near, term).index_add(0, pairs.far, term)

    def _slope(
        self, depth: Tensor, points: VisiblePoints, pixel: Tensor, Ts_camera_link: Tensor, views_K: Tensor
    ) -> Tensor:
        """Change of depth per pixel [views, height, width, 2] of the visible triangle's plane.

        On a plane n . p = d the depth is z = d / (n . ray), so dz/dx = -z (n_x / fx) / (n . ray).
        """
        normal = rotate(Ts_camera_link[:, :3, :3], self.geometry.face_planes[points.face, :3])
        towards = (normal * pixel_rays(points, views_K)).sum(-1, keepdim=True)
        towards = torch.where(towards.abs() < 1e-6, 1e-6, towards)
        z = depth.flatten()[pixel][:, None]
        slope = -z * normal[:, :2] / views_K[points.view, :2] / towards
        dense = slope.new_zeros(depth.numel(), 2).index_copy(0, pixel, slope)
        return dense.view(*depth.shape, 2)
