"""Renderer of masks and shaded images in NumPy."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ..arrays import Array, as_array
from ..model.keypoints import Keypoint
from ..model.scene import Scene, SceneState
from .rasterizer import SceneGeometry, link_transforms, phong, rasterize, vertices_in_camera, visible_points


class ImageRenderer:
    """Renderer of the arms in a scene's cameras, without gradients and without PyTorch; see `Renderer` for both.

    Args:
        width, height: size of the rendered images [px], by default the size of the first camera. The intrinsics of a
            state refer to the size of the camera and are scaled.
        cameras: names of the cameras to render, in this order; all by default. States contain all cameras of the scene,
            or only these.
        window: left, top, width and height [px] of the rendered part of these images; the whole image by default.
    """

    device: Any = None

    def __init__(
        self,
        scene: Scene,
        *,
        width: int | None = None,
        height: int | None = None,
        cameras: Sequence[str] | None = None,
        window: tuple[int, int, int, int] | None = None,
    ) -> None:
        self.scene = scene.with_cameras(cameras)
        self.width = width or self.scene.cameras[0].width
        self.height = height or self.scene.cameras[0].height
        self.geometry = SceneGeometry.of(scene, self.device)
        self._faces, self._surfaces = as_array(self.geometry.faces), as_array(self.geometry.face_surfaces)
        scale = [[self.width / camera.width, self.height / camera.height] * 2 for camera in self.scene.cameras]
        self._scale: Array = np.array(scale, np.float32)
        left, top, self.width, self.height = window or (0, 0, self.width, self.height)
        self._shift: Array = np.array([0, 0, left, top], np.float32)
        self._indices = [scene.cameras.index(camera) for camera in self.scene.cameras]
        self._count = len(scene.cameras)

    def segment(self, state: SceneState) -> Int[np.ndarray, "*batch cameras height width"]:
        """Index of the visible arm per pixel, -1 for background; faster than rendering, since only visibility is
        computed."""
        return self._labels(self.visibility(state)[0], self.geometry.face_arms)

    def segment_parts(self, state: SceneState) -> Int[np.ndarray, "*batch cameras height width"]:
        """Index into `carts_core.model.parts.PARTS` of the visible part per pixel, -1 for background."""
        return self._labels(self.visibility(state)[0], self.geometry.face_parts)

    def segment_links(self, state: SceneState) -> Int[np.ndarray, "*batch cameras height width"]:
        """Index of the visible link per pixel, -1 for background.

        Links are numbered across all arms, first `Robot.link_names` of the first arm, then those of the second arm.
        """
        return self._labels(self.visibility(state)[0], self.geometry.face_links)

    def visibility(
        self, state: SceneState
    ) -> tuple[Int[Array, "*batch cameras h w"], Float[Array, "*batch cameras h w"]]:
        """Index of the visible triangle per pixel, -1 for background, and its inverse depth [1/m], 0 there."""
        Ts, intrinsics = self._views(state)
        shape = (*Ts.shape[:-3], self.height, self.width)
        face_ids, inverse_depth = self._visibility(Ts.reshape(-1, *Ts.shape[-3:]), intrinsics.reshape(-1, 4))
        return face_ids.reshape(shape), inverse_depth.reshape(shape)

    def shaded(
        self, state: SceneState
    ) -> tuple[Float[np.ndarray, "cameras 3 height width"], Int[np.ndarray, "cameras height width"]]:
        """Images of one state (no batch), linear RGB in [0, 1] and black in the background, and `segment`."""
        Ts, intrinsics = self._views(state)
        face_ids, inverse_depth = self._visibility(Ts, intrinsics)
        points = visible_points(self.geometry, face_ids, inverse_depth, Ts, intrinsics)
        color = phong(self.geometry.face_colors[:, points.face], *points.transformed(Ts), self.scene.light)
        image = np.zeros((3, len(face_ids), self.height, self.width), np.float32)
        image.reshape(3, -1)[:, as_array(points.pixel)] = as_array(color)
        return image.swapaxes(0, 1), self._labels(face_ids, self.geometry.face_arms)

    def _labels(self, face_ids: Int[Array, "*shape"], face_labels: Int[Array, " F"]) -> Int[np.ndarray, "*shape"]:
        """Label of the visible triangle per pixel, -1 for background."""
        # The background is face -1, which indexes the last label.
        return np.take(np.append(as_array(face_labels), -1), as_array(face_ids))

    def _views(self, state: SceneState) -> tuple[Array, Array]:
        """Ts_camera_link [*batch, cameras, links, 4, 4] and scaled intrinsics of the rendered cameras."""
        state = self._own(state)
        if state.T_camera_world.shape[-3] == self._count and self._indices != list(range(self._count)):
            # If the state contains all cameras of the scene, the rendered cameras are selected.
            state = SceneState(
                state.joint_positions,
                state.T_world_base,
                state.T_camera_world[..., self._indices, :, :],
                state.intrinsics[..., self._indices, :],
                state.T_mount_world[..., self._indices, :, :],
            )
        return link_transforms(self.scene, state), state.intrinsics * self._scale - self._shift

    def _own(self, state: SceneState) -> SceneState:
        """The state in the renderer's library, on its device."""
        return state.numpy()

    def _visibility(self, views_T: Array, views_K: Array) -> tuple[Array, Array]:
        """Visible triangle and inverse depth [views, height, width]."""
        vertices = vertices_in_camera(self.geometry, views_T).swapaxes(-1, -2)
        size = (self.width, self.height)
        seen = [
            rasterize(as_array(points), self._faces, intrinsics.tolist(), *size, self._surfaces)
            for points, intrinsics in zip(vertices, views_K, strict=True)
        ]
        if len(seen) == 1:  # the common case, without a copy
            return seen[0][0][None], seen[0][1][None]
        face_ids, inverse_depth = (np.stack(arrays) for arrays in zip(*seen, strict=True))
        return face_ids, inverse_depth


def pick_point(
    scene: Scene, renderer: ImageRenderer, state: SceneState, pixel: tuple[float, float], radius: float = 0.0
) -> Keypoint | None:
    """Find the point of the rendered surface at a pixel, fixed to its link.

    Args:
        renderer: renderer of a single camera of the scene, at full size.
        pixel: column and row, pixel centres at 0.5 [px].
        radius: maximum distance to the centre of the nearest pixel with an arm [px]; 0 for the given pixel only.

    Returns:
        The point, named after its link; None if no arm is within the radius.
    """
    (camera,) = renderer.scene.cameras
    faces, inverse_depth = renderer.visibility(state)
    face_ids = as_array(faces[0])
    rows, columns = np.nonzero(face_ids >= 0)
    if not len(rows):
        return None
    centres = np.column_stack([columns, rows]) + 0.5
    nearest = int(np.linalg.norm(centres - pixel, axis=-1).argmin())
    row, column = int(rows[nearest]), int(columns[nearest])
    inside = (column, row) == (int(np.floor(pixel[0])), int(np.floor(pixel[1])))
    if not inside and np.linalg.norm(centres[nearest] - pixel) > radius:
        return None
    depth = 1.0 / float(inverse_depth[0, row, column])
    view = scene.cameras.index(scene.camera(camera.name))
    fx, fy, cx, cy = state.intrinsics[view].tolist()
    u, v = centres[nearest]
    p_camera = np.array([(u - cx) / fx * depth, (v - cy) / fy * depth, depth, 1.0])
    link = int(renderer.geometry.face_links[face_ids[row, column]])
    T_camera_link = as_array(link_transforms(scene, state)[view, link]).astype(np.float64)
    x, y, z, _ = np.linalg.solve(T_camera_link, p_camera).tolist()
    links = [(arm, number) for arm in scene.arms for number in range(len(arm.robot.link_names))]
    arm, number = links[link]
    return Keypoint(arm.name, arm.robot.link_names[number], number, (x, y, z))
