"""Path tracing with Mitsuba 3 (`scalar_rgb`), independent of the optimizer's renderer."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import rank_filter

from ...errors import CartsError
from ...model.camera import Camera
from ...model.scene import Arm
from ...settings import RenderConfig
from .scene import Tissue

LIGHTS_CAMERA = ((-0.0042, -0.0030, 0.0), (0.0042, -0.0030, 0.0))
"""Positions of the two light guides beside the lens, in the camera frame [m]."""
INTENSITY = 0.0055
"""Radiant intensity of each light [1/sr]; only ratios matter, since the exposure is adjusted."""
_TINT = (1.02, 1.0, 0.94)
NEAR = 0.002
"""Distance of the near plane [m]."""


@cache
def _mitsuba() -> ModuleType:
    try:
        mitsuba = import_module("mitsuba")
    except ImportError as error:
        raise CartsError(
            "Synthetic images are path-traced with Mitsuba 3, which is not installed. "
            "Install it with: pip install 'carts[synthesis]'"
        ) from error
    mitsuba.set_variant("scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


@dataclass(frozen=True)
class Part:
    """Posed mesh of an instrument."""

    link: int
    """Index of the link over all arms, for `Surface.link`."""
    vertices: Float[np.ndarray, "v 3"]
    """Vertices in the world [m]."""
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    material: dict[str, Any]
    """Mitsuba's description of the material."""


@dataclass(frozen=True)
class Surface:
    """Surface points seen by the pixels, one ray per pixel."""

    position: Float[np.ndarray, "h w 3"]
    """Point in the world [m]."""
    normal: Float[np.ndarray, "h w 3"]
    """Unit normal in the world."""
    link: Int[np.ndarray, "h w"]
    """Index as in `Part.link`, -1 on tissue."""
    depth: Float[np.ndarray, "h w"]
    """Distance along the camera's z axis [m]."""


class PathTracer:
    """Renderer of instruments over a patch of tissue, with the lights beside the first camera.

    Raises:
        CartsError: Mitsuba is not installed.
    """

    def __init__(self, tissue: Tissue, config: RenderConfig) -> None:
        self._mi = _mitsuba()
        self._config = config
        self._tissue_mesh = vertices, normals, faces, uv = tissue.mesh()
        material = {
            "type": "principled",
            "base_color": self._texture(tissue.albedo),
            "roughness": self._texture(tissue.roughness[..., None]),
            "specular": 0.5,
            "clearcoat": 0.6,
            "clearcoat_gloss": 0.92,
        }
        mesh = self._mesh("tissue", vertices, faces, material, uv=uv, normals=normals)
        # As a shape group, the tissue is added to the ray tracer's acceleration structure only once.
        group = self._mi.load_dict({"type": "shapegroup", "mesh": mesh})
        self._tissue: dict[str, Any] = {"tissue": group, "tissue_place": {"type": "instance", "group": group}}

    def radiance(
        self, parts: Sequence[Part], camera: Camera, T_light_world: np.ndarray, seed: int
    ) -> Float[np.ndarray, "h w 3"]:
        """Linear RGB radiance in arbitrary units; `T_light_world` is the pose of the camera that carries the lights."""
        T_world_light = np.linalg.inv(T_light_world)
        scene = self._instruments(parts) | self._tissue
        integrator = {"type": "path", "max_depth": self._config.bounces, "rr_depth": 16}
        samples = -(-self._config.samples // len(LIGHTS_CAMERA))
        # The lights are rendered separately, since random light selection would dominate the image noise.
        total = np.zeros((camera.height, camera.width, 3), np.float32)
        for number, place in enumerate(LIGHTS_CAMERA):
            light = {
                "type": "point",
                "position": list((T_world_light @ np.append(place, 1.0))[:3]),
                "intensity": {"type": "rgb", "value": [INTENSITY * tint for tint in _TINT]},
            }
            total += self._render(scene | {"light": light}, integrator, camera, samples, 2 * seed + number)[..., :3]
        return _without_specks(total)

    def coverage(self, parts: Sequence[Part], camera: Camera, samples: int = 16) -> Float[np.ndarray, "h w"]:
        """Share of each pixel that instruments cover in front of the tissue, in [0, 1].

        Instruments are rendered in black over luminous tissue and surroundings, so that both sides of a mesh count.
        """
        scene = self._instruments(parts, _BLACK)
        glow = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
        vertices, _, faces, _ = self._tissue_mesh
        scene["tissue"] = self._mesh("tissue", vertices, faces, _BLACK, emitter=glow)
        scene["space"] = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
        return 1.0 - self._render(scene, {"type": "path", "max_depth": 1}, camera, samples, 0)[..., 0]

    def surface(self, parts: Sequence[Part], camera: Camera, seed: int) -> Surface:
        """Surface points seen by the pixels."""
        scene = self._instruments(parts, _BLACK) | self._tissue
        integrator = {"type": "aov", "aovs": "position:position,normal:sh_normal,shape:shape_index"}
        layers = self._render(scene, integrator, camera, 1, seed)
        position, normal = layers[..., :3].astype(np.float64), layers[..., 3:6]
        # Mitsuba numbers shapes from 1 in scene order: first the parts, then the tissue; 0 is no hit.
        links = np.array([-1, *(part.link for part in parts), -1], dtype=np.int32)
        shape = np.round(layers[..., 6]).astype(int)
        T_camera_world = camera.T_camera_world
        depth = position @ T_camera_world[2, :3] + T_camera_world[2, 3]
        return Surface(position, normal, links[shape], depth)

    def _instruments(self, parts: Sequence[Part], material: dict[str, Any] | None = None) -> dict[str, Any]:
        """Mitsuba shapes of the parts, with `material` or their own materials."""
        meshes = {
            f"a_part_{number:03d}": self._mesh(
                f"part{number}", part.vertices, part.faces, material or part.material, normals=part.normals
            )
            for number, part in enumerate(parts)
        }
        return {"type": "scene", **meshes}

    def _texture(self, values: np.ndarray) -> dict[str, Any]:
        return {"type": "bitmap", "bitmap": self._mi.Bitmap(np.ascontiguousarray(values, np.float32)), "raw": True}

    def _mesh(
        self,
        name: str,
        vertices: np.ndarray,
        faces: np.ndarray,
        material: dict[str, Any],
        *,
        uv: np.ndarray | None = None,
        normals: np.ndarray | None = None,
        emitter: dict[str, Any] | None = None,
    ) -> Any:
        properties = self._mi.Properties()
        properties["material"] = self._mi.load_dict(material)
        if emitter is not None:
            properties["glow"] = self._mi.load_dict(emitter)
        mesh = self._mi.Mesh(
            name,
            len(vertices),
            len(faces),
            props=properties,
            has_vertex_normals=normals is not None,
            has_vertex_texcoords=uv is not None,
        )
        parameters = self._mi.traverse(mesh)
        parameters["faces"] = np.ascontiguousarray(faces, np.uint32).ravel()
        for part, values in (("positions", vertices), ("normals", normals), ("texcoords", uv)):
            if values is not None:
                parameters[f"vertex_{part}"] = np.ascontiguousarray(values, np.float32).ravel()
        parameters.update()
        return mesh

    def _render(
        self, scene: dict[str, Any], integrator: dict[str, Any], camera: Camera, samples: int, seed: int
    ) -> np.ndarray:
        fx, _, cx, cy = camera.intrinsics
        # In Mitsuba's camera frame, x is left and y up; in ours, x is right and y down.
        T_world_sensor = np.linalg.inv(camera.T_camera_world) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        scene = scene | {
            "integrator": integrator,
            "sensor": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(np.rad2deg(2.0 * np.arctan(camera.width / (2.0 * fx)))),
                "principal_point_offset_x": float(0.5 - cx / camera.width),
                "principal_point_offset_y": float(0.5 - cy / camera.height),
                "near_clip": NEAR,
                "far_clip": 10.0,
                "to_world": self._mi.ScalarTransform4f(T_world_sensor),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                },
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
        return np.array(self._mi.render(self._mi.load_dict(scene), spp=samples, seed=seed))


_METAL: dict[str, Any] = {
    "type": "roughconductor",
    "material": "Cr",
    "alpha": 0.22,
    "specular_reflectance": {"type": "rgb", "value": [0.92, 0.92, 0.90]},
}
_PLASTIC: dict[str, Any] = {
    "type": "roughplastic",
    "diffuse_reflectance": {"type": "rgb", "value": [0.022, 0.022, 0.024]},
    "alpha": 0.22,
}
_PAINT: dict[str, Any] = {"type": "roughplastic", "alpha": 0.25}
_BLACK: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}


def _without_specks(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Remove fireflies: limit each pixel to 1.25 times the third brightest value of its 3 x 3 neighbourhood.

    Real highlights are wider than a pixel.
    """
    limit = np.stack([rank_filter(image[..., channel], rank=-3, size=3) for channel in range(3)], axis=-1)
    return np.minimum(image, 1.25 * limit)


_DARK = 0.3
"""Brightness below which parts are rendered as plastic, as is the longest part of the shaft [1]."""


@dataclass(frozen=True)
class Stage:
    """Arms and their motion, at the scale of rendering.

    Links are numbered over all arms: link l of arm a is `a * len(link_names) + l`.
    """

    arms: tuple[Arm, ...]
    joints: tuple[Float[np.ndarray, "frames dofs"], ...]
    """True joint positions of each arm [rad, m]."""
    times: Float[np.ndarray, " frames"]
    """Time of each frame [s]."""
    scale: float = 1.0
    """Scale of the arms and their world, relative to the rendered world [1]."""
    painted: bool = False
    """Whether the robots are rendered in their own colours instead of with the materials of an instrument."""

    def Ts_world_link(self, frame: int, time_offset: float = 0.0) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Pose of every link at the time of a frame plus `time_offset` [s]."""
        transforms = []
        for arm, joints in zip(self.arms, self.joints, strict=True):
            positions = joints[frame]
            if time_offset and len(joints) > 1:
                positions = positions + time_offset * np.gradient(joints, self.times, axis=0)[frame]
            Ts_base_link = arm.robot.forward_kinematics(torch.from_numpy(positions)).numpy()
            Ts_world_link = arm.T_world_base @ Ts_base_link
            Ts_world_link[:, :3, 3] /= self.scale
            transforms.extend(Ts_world_link)
        return dict(enumerate(transforms))

    def parts(self, frame: int) -> list[Part]:
        """Posed meshes of the instruments at a frame."""
        transforms = self.Ts_world_link(frame)
        parts: list[Part] = []
        for index, arm in enumerate(self.arms):
            first = index * len(arm.robot.link_names)
            first_link = (mesh for mesh in arm.robot.meshes if mesh.link == 0)
            shaft = max(first_link, key=lambda mesh: np.ptp(mesh.vertices), default=None)
            for mesh in arm.robot.meshes:
                link = first + mesh.link
                rotation, translation = transforms[link][:3, :3], transforms[link][:3, 3]
                vertices = mesh.vertices / self.scale @ rotation.T + translation
                material = _METAL if mesh is not shaft and mesh.color.mean() > _DARK else _PLASTIC
                if self.painted:
                    color = [float(value) for value in mesh.color]
                    material = _PAINT | {"diffuse_reflectance": {"type": "rgb", "value": color}}
                parts.append(Part(link, vertices, mesh.normals @ rotation.T, mesh.faces, material))
        return parts

    def motion_in_image(
        self, frame: int, surface: Surface, camera: Camera, duration: float
    ) -> Float[np.ndarray, "h w 2"]:
        """Image motion [px] of each pixel's surface point during `duration` [s]; 0 on tissue."""
        motion = np.zeros((*surface.link.shape, 2), np.float32)
        now = self.Ts_world_link(frame)
        before, after = self.Ts_world_link(frame, -duration / 2), self.Ts_world_link(frame, duration / 2)
        for link, T_world_link in now.items():
            there = surface.link == link
            if not there.any():
                continue
            points = (surface.position[there] - T_world_link[:3, 3]) @ T_world_link[:3, :3]
            motion[there] = _project(points, after[link], camera) - _project(points, before[link], camera)
        return motion


def _project(points: np.ndarray, T_world_link: np.ndarray, camera: Camera) -> np.ndarray:
    T_camera_link = camera.T_camera_world @ T_world_link
    p_camera = points @ T_camera_link[:3, :3].T + T_camera_link[:3, 3]
    fx, fy, _, _ = camera.intrinsics
    return p_camera[:, :2] / p_camera[:, 2:] * (fx, fy)
