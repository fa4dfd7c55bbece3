"""Real frames, altered in memory to the conditions of the synthetic domains.

Surfaces are derived from measured kinematics and masks; replacement backgrounds are path-traced tissue.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from ...export import image_png
from ...files import holds_file, output_path, write_bytes
from ...model.mesh_cache import cache_dir
from ...model.scene import Scene
from ...recording import Frame, MeanBackground
from ...recording import Sequence as SequenceFile
from ...recording.background import evenly_spaced
from ...recording.images import read_image
from ...rendering import Renderer
from ...rendering.rasterizer import link_transforms, visible_points
from ...settings import DOMAINS, DomainConfig, EndoscopeConfig, SensorConfig, SynthesisConfig
from ..synthesis.domains import Conditions, View, expose, exposure_gain, linear
from ..synthesis.path_tracer import PathTracer, Surface
from ..synthesis.scene import KINDS, Tissue, grow_tissue, place_cameras
from .rooms import AlteredSequence


def backdrop(width: int, height: int, seed: int) -> UInt8[np.ndarray, "h w 3"]:
    """Path-traced image of tissue without instruments, from the cache; `CartsError` if Mitsuba is not installed."""
    path = output_path(cache_dir(), "benchmark", f"backdrop_{seed}_{width}x{height}.png")
    if not holds_file(path):
        config = SynthesisConfig(seed=seed, endoscope=EndoscopeConfig(width=width, height=height))
        rng = config.rng("backdrop")
        size = config.render.tissue_resolution, config.render.texture_resolution
        tissue = grow_tissue(KINDS[int(rng.integers(len(KINDS)))], *size, rng)
        camera = place_cameras(config.endoscope)[0]
        radiance = PathTracer(tissue, config.render).radiance([], camera, camera.T_camera_world, seed=0)
        picture = expose(exposure_gain(radiance, config.sensor) * radiance, config.sensor, rng)
        write_bytes(path, image_png(picture))
    return read_image(path.path)


_CLEARANCE = 0.005
"""Distance between the deepest tip and the plane behind it [m]."""
DISTANCE = EndoscopeConfig().distance
"""Distance from the camera to the plane in the scaled world, at which blood and smoke are simulated [m]."""


class RealSurface:
    """Surface model of a real frame: instruments in front of a plane parallel to the image.

    The world frame is as in synthesis: the plane is z = 0, and the camera is above the origin and looks straight down.
    The world is scaled to the distance of the synthetic camera, since smoke and the size of drops depend on the
    distance.

    Args:
        scene: scene with one camera.
        recording: measured joint positions of frames, arm -> [dofs], which determine the distance of the plane.
    """

    def __init__(self, scene: Scene, recording: Sequence[Mapping[str, np.ndarray]]) -> None:
        self._scene = scene
        self._renderer = Renderer(scene)
        depths = [float(self._rendered(measured).depth.max()) for measured in recording]
        self._scale = DISTANCE / (max(*depths, 0.02) + _CLEARANCE)
        self._T_world_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        self._T_world_camera[2, 3] = DISTANCE
        self.lens: np.ndarray = self._T_world_camera[:3, 3]
        """Position of the lens in the world [m]."""
        camera = scene.cameras[0]
        fx, fy, cx, cy = camera.intrinsics
        rows, columns = np.indices((camera.height, camera.width)) + 0.5
        self._rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], -1)

    def Ts_world_link(self, measured: Mapping[str, np.ndarray] | None) -> dict[int, Float[np.ndarray, "4 4"]]:
        """Link -> pose in the scaled world [m]; empty without joint positions."""
        if measured is None:
            return {}
        Ts_camera_link = link_transforms(self._scene, self._scene.state(measured))[0].double().numpy()
        Ts_camera_link[:, :3, 3] *= self._scale
        return dict(enumerate(self._T_world_camera @ Ts_camera_link))

    def of(self, mask: Bool[np.ndarray, "h w"], measured: Mapping[str, np.ndarray] | None) -> Surface:
        """Surface of a frame: for pixels of the mask, the surface at the nearest pixel of the measured arms; the plane
        elsewhere.

        `measured` maps arms to joint positions [rad, m]; None without arms.
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
        """Scaled depth, normal in the world, and link of the arms for each pixel; the link is -1 in the background."""
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


_FRAME_INTERVAL = 0.25
"""Assumed frame interval of a recording without timestamps [s]."""
_REFLECTANCE = 0.3
"""Assumed reflectance of the background, from which the lamp's intensity is estimated."""
_QUIET = SensorConfig(vignette=0.0, blur=0.0, sharpening=0.0, full_well=1e6, read_noise=0.0)
"""Sensor without lens effects and noise, which real frames already have."""
_NOISY = dataclasses.replace(SensorConfig(), vignette=0.0, blur=0.0, sharpening=0.0)
"""Sensor with noise but without lens effects, for low light."""
_MOMENTS = 5


class Counterfactual(AlteredSequence):
    """Real sequence altered to all synthetic domains, with the code for blood, smoke and low light of the synthesis.

    Blood and smoke use the depth of the measured arms, extended to the pixels of the mask, and of a plane behind the
    deepest tip. In `background_change`, the masked instrument is composited over `backdrop` [camera height, width, 3].
    """

    def __init__(
        self,
        sequence: SequenceFile,
        camera: str,
        backdrop: UInt8[np.ndarray, "h w 3"],
        seed: int,
        strengths: DomainConfig | None = None,
    ) -> None:
        super().__init__(sequence)
        self._camera, self._backdrop = camera, backdrop
        self._config = SynthesisConfig(seed=seed, domain=strengths or DomainConfig())
        self._surface = RealSurface(
            sequence.scene.with_cameras([camera]),
            [sequence.frame(i, cameras=()).measured for i in evenly_spaced(len(sequence))],
        )
        self._conditions = Conditions(self._config, _relief(seed))
        self._clean = sequence.background(camera)
        brightness = float(np.median(linear(self._clean)))
        self._lamp = np.pi * DISTANCE**2 * brightness / _REFLECTANCE
        self._backgrounds: dict[str, np.ndarray] = {}

    def frame(self, index: int, domain: str | None = None, cameras: Iterable[str] | None = None) -> Frame:
        """Frame with its image altered to a domain; other cameras are only available in the regular domain."""
        domain = domain or DOMAINS[0]
        if domain == DOMAINS[0]:
            return dataclasses.replace(self._sequence.frame(index, cameras=cameras or [self._camera]), domain=domain)
        frame = self._sequence.frame(index, cameras=[self._camera])
        assert frame.masks is not None
        image, mask = frame.images[self._camera], frame.masks[self._camera]
        altered = self._altered(domain, image, mask, frame.measured, index)
        return dataclasses.replace(frame, domain=domain, images={self._camera: altered})

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """Mean background under the condition of the domain, averaged over several points in time."""
        domain, regular = domain or DOMAINS[0], self._sequence.mean_background(camera)
        if domain == DOMAINS[0]:
            return regular
        if domain not in self._backgrounds:
            nothing = np.zeros(self._clean.shape[:2], bool)
            moments = [
                self._altered(domain, self._clean, nothing, None, index).astype(np.float32)
                for index in evenly_spaced(len(self), _MOMENTS)
            ]
            self._backgrounds[domain] = np.rint(np.mean(moments, axis=0)).astype(np.uint8)
        return dataclasses.replace(regular, image=self._backgrounds[domain])

    def _altered(
        self,
        domain: str,
        image: UInt8[np.ndarray, "h w 3"],
        mask: Bool[np.ndarray, "h w"],
        measured: dict[str, np.ndarray] | None,
        index: int,
    ) -> UInt8[np.ndarray, "h w 3"]:
        times = self._sequence.timestamps
        time = index * _FRAME_INTERVAL if times is None else float(times[index] - times[0])
        if domain == "background_change":
            # The edge is soft, as in an image taken through a lens.
            cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)[..., None]
            return np.rint(cover * image + (1.0 - cover) * self._backdrop).astype(np.uint8)
        if domain == "simulated_smoke":
            return self._conditions.overlay.over(image, time)
        surface, links = self._surface.of(mask, measured), self._surface.Ts_world_link(measured)
        view = View(index, time, 0, linear(image), self._lamp, None, surface, None, self._surface.lens, links)
        sensor = _NOISY if domain == "low_brightness" else _QUIET
        return expose(self._conditions.light(domain, view), sensor, self._config.rng("noise", domain, index))


@cache
def _relief(seed: int) -> Tissue:
    """Invisible relief of the background, in whose hollows blood collects."""
    return grow_tissue("muscle", 256, 1024, SynthesisConfig(seed=seed).rng("tissue"))
