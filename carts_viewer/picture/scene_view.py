"""The 3D scene of the page: the images of the frame with their overlays, and behind them arms and cameras.

viser's world frame is that of the shown camera (OpenCV axes), so the endoscope view looks from the origin along z. The
recording's world frame is a node that is moved when another camera is shown.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from jaxtyping import Float, UInt8
from viser import transforms

from carts_core.model.camera import Camera
from carts_core.model.scene import Arm, Scene, SceneState
from carts_viewer.picture.layers import ARM_COLORS, Rgba
from carts_viewer.transport.viser_private import image_file

LENS = "/lens"
"""Lines from the camera centre to the corners of its image; hidden like `WORLD`."""
FRAME = "/frame"
OVERLAY = "/overlay"
GRID = "/grid"
"""Grid of centimetres in the 3D view."""
OTHERS = "/others"
"""Frames and overlays of the other cameras, beside those of the shown camera; hidden in the 3D view by a script."""
WORLD = "/world"
"""Arms and other cameras; hidden by a script in the endoscope view, where the frame covers them."""
_LENS_COLOR = (45, 212, 167)
_OTHER_COLOR = (150, 160, 165)
_GHOST, _GHOST_OPACITY = (200, 205, 210), 0.28
"""Colour and opacity of the measured arms."""
_AXES = 0.012
"""Length of the axes of base and tip [m]."""
_GRID_CELL = 0.01
"""Distance between grid lines [m]."""
Colour = Callable[[Any], tuple[int, int, int]]
"""Maps a link's own colour to the displayed colour."""
_JPEG_QUALITY = 88
_DEPTH_SHARE = 0.25
_MIN_DEPTH = 0.005
_OVERLAY_SHARE = 0.99
_SPACING = 1.01
"""Distance between the centres of adjacent images, relative to the size of an image."""


class SceneView:
    """3D scene of a tab."""

    def __init__(self, shown: viser.SceneApi, scene: Scene, state: SceneState, camera: str) -> None:
        """`state` determines the distance of the images from the camera centre."""
        self._shown = shown
        self._scene = scene
        self._depth = max(_DEPTH_SHARE * _distance_of_arms(scene, state, camera), _MIN_DEPTH)
        self._links: list[list[viser.FrameHandle]] = []
        self._outlines: dict[str, viser.LineSegmentsHandle] = {}
        self._planes: dict[str, tuple[tuple[Camera, ...], viser.ImageHandle]] = {}
        self._world = shown.add_frame(WORLD, show_axes=False)
        self._measured: list[list[viser.FrameHandle]] = []
        self._poses: dict[str, bytes] = {}
        self._add_arms()
        self._add_cameras()
        self._add_grid()

    def show_frame(self, image: UInt8[np.ndarray, "height width 3"], camera: Camera) -> bool:
        """Show an image of this camera on its image plane (the base of its frustum).

        Returns whether it was sent: viser does not send the same file again.
        """
        return self._put(FRAME, image, camera, self._depth, "jpeg")

    def show_overlay(self, picture: Rgba, camera: Camera) -> bool:
        """Show an overlay of this camera's image, slightly nearer to the camera centre than the image.

        Returns whether it was sent, as `show_frame` does.
        """
        return self._put(OVERLAY, picture, camera, _OVERLAY_SHARE * self._depth, "png")

    def show_beside(self, camera: Camera, active: Camera, image: np.ndarray | None, overlay: Rgba | None) -> None:
        """Show another camera's image and overlay beside those of the active camera; None leaves them unchanged.

        Images form a grid in the order of the cameras. Each is scaled to the size of the active camera's image, which
        remains on its image plane.
        """
        names = [own.name for own in self._scene.cameras]
        place, width, height = self._beside(names.index(camera.name), names.index(active.name), camera, active)
        root = f"{OTHERS}/{names.index(camera.name)}"
        for node, picture, share, kind in (("frame", image, 1.0, "jpeg"), ("overlay", overlay, _OVERLAY_SHARE, "png")):
            if picture is not None:
                position = (share * place[0], share * place[1], share * place[2])
                size = (width * share, height * share)
                self._plane(f"{root}/{node}", picture, (camera, active), size, position, kind)

    def hide_beside(self, camera: Camera) -> None:
        """Remove the image and overlay of this camera."""
        number = [own.name for own in self._scene.cameras].index(camera.name)
        for node in ("frame", "overlay"):
            known = self._planes.pop(f"{OTHERS}/{number}/{node}", None)
            if known is not None:
                known[1].remove()

    def _beside(
        self, index: int, active_index: int, camera: Camera, active: Camera
    ) -> tuple[tuple[float, float, float], float, float]:
        """Position, width and height of another camera's image [m]."""
        fx, fy, cx, cy = active.intrinsics
        z = self._depth
        cell = active.width / fx * z, active.height / fy * z
        columns = 2 if len(self._scene.cameras) in (2, 4) else 3
        right, down = index % columns - active_index % columns, index // columns - active_index // columns
        centre = (active.width / 2 - cx) / fx * z, (active.height / 2 - cy) / fy * z
        scale = min(cell[0] / camera.width, cell[1] / camera.height)
        position = (centre[0] + _SPACING * right * cell[0], centre[1] + _SPACING * down * cell[1], z)
        return position, scale * camera.width, scale * camera.height

    def sent(self, name: str) -> bytes:
        """The last sent image file of `FRAME` or `OVERLAY`."""
        return image_file(self._planes[name][1])

    def show_pose(self, state: SceneState, camera: str) -> None:
        """Move arms and cameras to their poses in the frame of this camera."""
        extrinsics = {own.name: T.astype(float) for own, T in zip(self._scene.cameras, state.T_view_world, strict=True)}
        if not self._unmoved(WORLD, camera.encode() + b"".join(T.tobytes() for T in extrinsics.values())):
            _place(self._world, extrinsics[camera])
            for name, outline in self._outlines.items():
                _place(outline, np.linalg.inv(extrinsics[name]))
                outline.visible = name != camera
        self._place_arms(self._links, state)

    def show_measured(self, state: SceneState) -> None:
        """Move the translucent copies of the arms to their measured poses."""
        self._place_arms(self._measured, state)

    def _place_arms(self, arms: list[list[viser.FrameHandle]], state: SceneState) -> None:
        bases = state.T_world_base.astype(float)
        for arm, nodes, T_world_base, joints in zip(self._scene.arms, arms, bases, state.joint_positions, strict=True):
            if self._unmoved(nodes[0].name, T_world_base.tobytes() + joints.tobytes()):
                continue
            Ts_base_link = arm.robot.forward_kinematics(joints).astype(float)
            for node, T_base_link in zip(nodes, Ts_base_link, strict=True):
                _place(node, T_world_base @ T_base_link)

    def _unmoved(self, name: str, pose: bytes) -> bool:
        """Whether the pose of the node with this name is the same as in the last call."""
        before, self._poses[name] = self._poses.get(name), pose
        return before == pose

    def _put(self, name: str, image: np.ndarray, camera: Camera, z: float, kind: str) -> bool:
        """Show an image as a plane at depth z whose projection by the intrinsics is the image itself.

        Returns whether it was sent.
        """
        fx, fy, cx, cy = camera.intrinsics
        size = (camera.width / fx * z, camera.height / fy * z)
        position = ((camera.width / 2 - cx) / fx * z, (camera.height / 2 - cy) / fy * z, z)
        before = self.sent(name) if name in self._planes else None
        new = self._plane(name, image, (camera,), size, position, kind)
        if new and name == FRAME:
            self._outline(LENS, camera, _LENS_COLOR)
        return new or self.sent(name) != before

    def _plane(
        self,
        name: str,
        image: np.ndarray,
        cameras: tuple[Camera, ...],
        size: tuple[float, float],
        position: tuple[float, float, float],
        kind: str,
    ) -> bool:
        """Show an image as a plane [m]; returns whether the plane is new, as after a change of cameras."""
        if name in self._planes and self._planes[name][0] == cameras:
            self._planes[name][1].image = image
            return False
        handle = self._shown.add_image(
            name,
            image,
            *size,
            format="jpeg" if kind == "jpeg" else "png",
            jpeg_quality=_JPEG_QUALITY,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )
        self._planes[name] = (cameras, handle)
        return True

    def _outline(self, name: str, camera: Camera, color: tuple[int, int, int]) -> viser.LineSegmentsHandle:
        """Lines from a camera centre to the corners of its image at the frame's depth, and around the image."""
        fx, fy, cx, cy = camera.intrinsics
        z = self._depth
        corners = [
            ((u - cx) / fx * z, (v - cy) / fy * z, z)
            for u, v in ((0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height))
        ]
        edges = [(corner, corners[(number + 1) % 4]) for number, corner in enumerate(corners)]
        rays = [((0.0, 0.0, 0.0), corner) for corner in corners]
        return self._shown.add_line_segments(
            name, np.array([*edges, *rays], np.float32), color, thickness=2.0, thickness_units="screen"
        )

    def _add_arms(self) -> None:
        for number, arm in enumerate(self._scene.arms):
            accent = ARM_COLORS[number % len(ARM_COLORS)]
            self._links.append(self._add_arm(f"{WORLD}/{number}", arm, lambda own, by=accent: _mixed(own, by), None))
            self._measured.append(self._add_arm(f"{WORLD}/measured {number}", arm, lambda _: _GHOST, _GHOST_OPACITY))
            # The axes of the base, and of the tip's link.
            for link in (0, -1):
                name = arm.robot.link_names[link]
                self._shown.add_frame(f"{WORLD}/{number}/{name}/axes", axes_length=_AXES, axes_radius=0.03 * _AXES)

    def _add_arm(self, root: str, arm: Arm, color: Colour, opacity: float | None) -> list[viser.FrameHandle]:
        """The links of an arm with their meshes."""
        scene = self._shown
        links = [scene.add_frame(f"{root}/{name}", show_axes=False) for name in arm.robot.link_names]
        for part, mesh in enumerate(arm.robot.meshes):
            scene.add_mesh_simple(
                f"{root}/{arm.robot.link_names[mesh.link]}/{part}",
                np.asarray(mesh.vertices, np.float32),
                np.asarray(mesh.faces, np.uint32),
                color=color(mesh.color),
                opacity=opacity,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        return links

    def _add_grid(self) -> None:
        """A grid of centimetres below the arms, parallel to the optical axis and the x axis of the shown camera."""
        self._shown.add_grid(
            GRID,
            width=20 * _GRID_CELL,
            height=20 * _GRID_CELL,
            plane="xz",
            cell_size=_GRID_CELL,
            cell_color=(96, 104, 110),
            section_color=(130, 140, 146),
            section_size=5 * _GRID_CELL,
            position=(0.0, 6.0 * self._depth, 4.0 * self._depth),
        )

    def _add_cameras(self) -> None:
        for camera in self._scene.cameras:
            node = f"{WORLD}/camera {camera.name}"
            self._outlines[camera.name] = self._outline(node, camera, _OTHER_COLOR)


def _place(node: viser.SceneNodeHandle, T_parent_node: Float[np.ndarray, "4 4"]) -> None:
    node.wxyz = transforms.SO3.from_matrix(T_parent_node[:3, :3]).wxyz
    node.position = T_parent_node[:3, 3]


def _distance_of_arms(scene: Scene, state: SceneState, camera: str) -> float:
    """Depth of the nearest link in front of the camera [m], or a default depth."""
    row = [own.name for own in scene.cameras].index(camera)
    depths = []
    for arm, T_world_base, joints in zip(scene.arms, state.T_world_base, state.joint_positions, strict=True):
        Ts = state.T_view_world[row] @ T_world_base @ arm.robot.forward_kinematics(joints)
        depths += [float(z) for z in Ts[..., 2, 3] if z > 0.0]
    return min(depths, default=0.1)


def _mixed(color, accent: tuple[int, int, int]) -> tuple[int, int, int]:
    """A link's own colour mixed with the arm's colour, so that arms can be distinguished."""
    own = np.asarray(color, float)[:3] * 255
    return tuple(int(value) for value in np.clip(0.75 * own + 0.25 * np.array(accent), 0, 255))  # type: ignore[return-value]
