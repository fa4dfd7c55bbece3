"""Real frames under the conditions of the synthetic domains, altered in memory."""

import dataclasses
from collections.abc import Callable, Iterable
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ...recording import Frame, MeanBackground, Sequence
from ...recording.background import spread
from ...settings import DOMAINS, DomainConfig, SensorConfig, SynthesisConfig
from ..synthesis.domains import Bleeding, Smoke, SmokeOverlay, expose, linear
from ..synthesis.path_tracer import Surface
from ..synthesis.scene import Tissue, grow_tissue
from .real_surface import DISTANCE, RealSurface

_FRAME_INTERVAL = 0.25
"""Between frames of a recording without timestamps [s]."""
_REFLECTANCE = 0.3
"""Of the background, from which the strength of the lamp is guessed."""
_QUIET = SensorConfig(vignette=0.0, blur=0.0, sharpening=0.0, full_well=1e6, read_noise=0.0)
"""A real frame has its lens and its noise already."""
_NOISY = dataclasses.replace(SensorConfig(), vignette=0.0, blur=0.0, sharpening=0.0)
"""In low light the sensor's noise takes over."""
_MOMENTS = 5


class Counterfactual:
    """A real sequence in all domains of the synthetic ones, with their code for blood, smoke and low light.

    Depth, which blood and smoke need, is that of the arms as measured, carried to the mask's pixels, before a plane
    behind the deepest tip. In `background_change` the masked instrument is put before another background.

    Args:
        sequence: with masks of the camera.
        camera: the camera that takes part.
        backdrop: the other background, of the camera's size.
        seed: of blood, smoke and noise.
        strengths: of the conditions; those of the synthetic domains by default.
    """

    def __init__(
        self,
        sequence: Sequence,
        camera: str,
        backdrop: UInt8[np.ndarray, "h w 3"],
        seed: int,
        strengths: DomainConfig | None = None,
    ) -> None:
        self.scene, self.timestamps = sequence.scene, sequence.timestamps
        self.measured_joints = sequence.measured_joints
        self._sequence, self._camera, self._backdrop = sequence, camera, backdrop
        self._config = SynthesisConfig(seed=seed, domain=strengths or DomainConfig())
        self._surface = RealSurface(
            sequence.scene.with_cameras([camera]),
            [sequence.frame(i, cameras=()).measured for i in spread(len(sequence))],
        )
        self._bleeding = Bleeding(_relief(seed), self._config.domain, self._config.rng("bleeding"))
        self._smoke = Smoke(self._config.domain, self._config.rng("smoke"))
        self._overlay = SmokeOverlay(self._config.domain.overlay_opacity, self._config.rng("overlay"))
        self._clean = sequence.background(camera)
        brightness = float(np.median(linear(self._clean)))
        self._lamp = np.pi * DISTANCE**2 * brightness / _REFLECTANCE
        self._backgrounds: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, index: int, domain: str | None = None, cameras: Iterable[str] | None = None) -> Frame:
        """A frame of the sequence with its image in a domain; only the regular one has other cameras, too."""
        domain = domain or DOMAINS[0]
        if domain == DOMAINS[0]:
            return dataclasses.replace(self._sequence.frame(index, cameras=cameras or [self._camera]), domain=domain)
        frame = self._sequence.frame(index, cameras=[self._camera])
        assert frame.masks is not None
        image, mask = frame.images[self._camera], frame.masks[self._camera]
        altered = self._altered(domain, image, mask, frame.measured, self._time(index), index)
        return dataclasses.replace(frame, domain=domain, images={self._camera: altered})

    def background(self, camera: str, domain: str | None = None) -> UInt8[np.ndarray, "h w 3"]:
        """The background under the domain's condition, averaged over some moments."""
        domain = domain or DOMAINS[0]
        if domain == DOMAINS[0]:
            return self._sequence.background(camera)
        if domain not in self._backgrounds:
            nothing = np.zeros(self._clean.shape[:2], bool)
            moments = [
                self._altered(domain, self._clean, nothing, None, self._time(index), index).astype(np.float32)
                for index in spread(len(self._sequence), _MOMENTS)
            ]
            self._backgrounds[domain] = np.rint(np.mean(moments, axis=0)).astype(np.uint8)
        return self._backgrounds[domain]

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """The same with where it is known."""
        regular = self._sequence.mean_background(camera)
        return dataclasses.replace(regular, image=self.background(camera, domain))

    def _time(self, index: int) -> float:
        times = self._sequence.timestamps
        return index * _FRAME_INTERVAL if times is None else float(times[index] - times[0])

    def _altered(
        self,
        domain: str,
        image: UInt8[np.ndarray, "h w 3"],
        mask: Bool[np.ndarray, "h w"],
        measured: dict[str, np.ndarray] | None,
        time: float,
        index: int,
    ) -> UInt8[np.ndarray, "h w 3"]:
        rng = self._config.rng("noise", domain, index)

        def lit(change: Callable[[Surface], Float[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h w 3"]:
            return expose(change(self._surface.of(mask, measured)), _QUIET, rng)

        match domain:
            case "low_brightness":
                return expose(linear(image) * self._config.domain.low_brightness, _NOISY, rng)
            case "bleeding":
                links = self._surface.Ts_world_link(measured)
                return lit(lambda at: self._bleeding.stain(linear(image), at, links, self._surface.lens, self._lamp))
            case "smoke":
                return lit(
                    lambda at: self._smoke.haze(linear(image), at.position, self._surface.lens, self._lamp, time)
                )
            case "background_change":
                # A soft seam, as a lens makes it.
                cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)[..., None]
                return np.rint(cover * image + (1.0 - cover) * self._backdrop).astype(np.uint8)
            case "simulated_smoke":
                return self._overlay.over(image, time)
        raise AssertionError(f"no such domain: {domain}")


@cache
def _relief(seed: int) -> Tissue:
    """In whose hollows blood gathers; nothing else of it is seen."""
    return grow_tissue("muscle", 256, 1024, SynthesisConfig(seed=seed).rng("tissue"))
