"""The images of a frame in a size in which they are compared."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..features.extractor import FeatureExtractor
from ..rendering import Renderer
from ..scene import Scene
from ..settings import OptimizerSettings
from .counterfactual import Backgrounds, without_background
from .inputs import pixel_weights, stacked_images, working_size
from .veil import certainty, transmission, unveiled


@dataclass(frozen=True)
class Scale:
    """Images in one size, and what their pixels are worth."""

    zoom: float
    """How many times larger than the working image [1]."""
    size: tuple[int, int]
    """Width and height [px]."""
    images: Float[Tensor, "cameras 3 h w"]
    """RGB in [0, 1], without smoke and haze."""
    weight: Float[Tensor, "cameras 1 h w"]
    """0 where an occluder is known to be, 1 elsewhere."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """What a pixel tells, as a share of what it would tell without smoke and haze [1]."""
    explained: Float[Tensor, "cameras 1 h w"] | None
    """Share of what is seen of arms that the empty background shows as well [1]; None where that is not known."""
    whole: Renderer
    """Of the whole image."""


def scaled(
    scene: Scene,
    images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
    ignore: Mapping[str, Bool[np.ndarray, "h w"]],
    zoom: float,
    settings: OptimizerSettings,
    extractor: FeatureExtractor,
    backgrounds: Backgrounds | None = None,
) -> Scale:
    """Images at `zoom` times the working size, as far as the network's stride allows.

    Args:
        scene: with the cameras that take part.
        images: camera name -> observed RGB image.
        ignore: camera name -> pixels that show an occluder.
        zoom: times the working size [1].
        settings: working size, and how much of a veil is taken off.
        extractor: the networks.
        backgrounds: of the cameras, where they are known.

    Raises:
        SettingsError: an image is missing, or an image or a mask is of another size than its camera.
    """
    device = extractor.device
    unit, _ = working_size(scene, settings.working_width, extractor.stride)
    size = working_size(scene, round(settings.working_width * zoom), extractor.stride)
    stacked = stacked_images(scene, images, size, "image").to(device)
    through, explained = transmission(stacked, settings.unveil), None
    if backgrounds is not None and backgrounds.covers(scene):
        background = backgrounds.at(scene, size, settings.unveil, extractor)
        changed = background.changed(stacked, size[0] / unit)
        if background.deceptive:
            stacked, through = without_background(stacked, changed), torch.ones_like(through)
        else:
            explained = background.seen * (1.0 - changed)
    return Scale(
        zoom=size[0] / unit,
        size=size,
        images=unveiled(stacked, through),
        weight=pixel_weights(scene, ignore, size).to(device),
        # Smoke, which the network has not seen, misleads it by more than noise does: measured, see docs/experiments.
        certainty=certainty(through).square(),
        explained=explained,
        whole=Renderer(scene, width=size[0], height=size[1], device=device),
    )
