"""The counterfactual domains: one motion, six conditions."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from ...settings import SynthesisConfig
from .blood import Bleeding
from .path_tracer import INTENSITY, LIGHTS_CAMERA, Surface
from .sensor import expose
from .smoke import Smoke, SmokeOverlay
from .tissue import Tissue


@dataclass(frozen=True)
class View:
    """One camera's view of one frame, before any condition is applied."""

    frame: int
    time: float
    """[s]"""
    camera: int
    """Index of the camera."""
    light: Float[np.ndarray, "h w 3"]
    """Linear RGB over the regular background, 1 = white."""
    gain: float
    """From the renderer's radiance to `light`."""
    other_light: Float[np.ndarray, "h w 3"] | None
    """The same over the other background; None where that domain is not wanted."""
    surface: Surface
    motion: Float[np.ndarray, "h w 2"]
    """[px] while the shutter is open."""
    lens: Float[np.ndarray, "3"]
    """The lens, in the world [m]."""
    Ts_world_link: Mapping[int, Float[np.ndarray, "4 4"]]


class Conditions:
    """Turns a view into the pictures of all domains.

    Args:
        config: what is wanted.
        tissue: the regular background, which bleeds.
    """

    def __init__(self, config: SynthesisConfig, tissue: Tissue) -> None:
        self._config = config
        self._bleeding = Bleeding(tissue, config.domain, config.rng("bleeding"))
        self._smoke = Smoke(config.domain, config.rng("smoke"))
        self._overlay = SmokeOverlay(config.domain.overlay_opacity, config.rng("overlay"))

    def image(self, domain: str, view: View) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of one domain."""
        if domain == "simulated_smoke":
            return self._overlay.over(self.image("regular", view), view.time)
        rng = self._config.rng("noise", domain, view.frame, view.camera)
        return expose(self._light(domain, view), self._config.sensor, rng, view.motion)

    def _light(self, domain: str, view: View) -> Float[np.ndarray, "h w 3"]:
        lamp = INTENSITY * len(LIGHTS_CAMERA) * view.gain
        match domain:
            case "regular":
                return view.light
            case "low_brightness":
                return view.light * self._config.domain.low_brightness
            case "bleeding":
                return self._bleeding.stain(view.light, view.surface, view.Ts_world_link, view.lens, lamp)
            case "smoke":
                return self._smoke.haze(view.light, view.surface.position, view.lens, lamp, view.time)
            case "background_change" if view.other_light is not None:
                return view.other_light
        raise AssertionError(f"no light for domain {domain}")
