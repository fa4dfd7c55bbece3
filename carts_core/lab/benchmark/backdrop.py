"""Tissue without instruments: what real frames are put before in the domain `background_change`."""

import numpy as np
from jaxtyping import UInt8

from ...export import image_png
from ...files import holds_file, output_path, write_bytes
from ...model.mesh_cache import cache_dir
from ...recording.images import read_image
from ...settings import EndoscopeConfig, SynthesisConfig
from ..synthesis.domains import expose, exposure_gain
from ..synthesis.path_tracer import PathTracer
from ..synthesis.scene import KINDS, grow_tissue, place_cameras


def backdrop(width: int, height: int, seed: int) -> UInt8[np.ndarray, "h w 3"]:
    """A path-traced picture of tissue alone, kept in the cache.

    Raises:
        CartsError: Mitsuba is not installed.
    """
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
