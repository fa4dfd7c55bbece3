"""Removal of smoke and haze from images before they are compared.

Haze adds a grey that varies slowly over the image, and reduces contrast in proportion. Tissue reflects little in at
least one colour, so the minimum over colours and nearby pixels estimates the added grey: the dark channel prior of He,
Sun and Tang, "Single Image Haze Removal Using Dark Channel Prior" (CVPR 2009).
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from .working_image import attention, smoothed

_REACH = 1 / 32
"""Radius of the dark channel, and standard deviation of the smoothing of haze [image widths]."""

_COARSER = 4
"""Downscaling factor for the estimate of haze [1]."""

_AIRLIGHT = 0.75
"""Value of opaque haze, in each colour [1]."""

_LEAST = 0.25
"""Smallest transmission [1]; dehazing amplifies noise by its inverse."""


def transmission(images: Float[Tensor, "n 3 h w"], share: float) -> Float[Tensor, "n 1 h w"]:
    """Estimate the transmission of haze at each pixel, from `_LEAST` to 1.

    Args:
        images: RGB in [0, 1].
        share: share of the estimated haze to remove [1]; 0 for none.
    """
    if share == 0:
        return torch.ones_like(images[:, :1])
    darkest = functional.interpolate(images.amin(1, keepdim=True), scale_factor=1 / _COARSER, mode="area")
    reach = max(round(_REACH * darkest.shape[-1]), 1)
    haze = smoothed(-attention(-darkest, reach), reach)
    haze = functional.interpolate(haze, images.shape[-2:], mode="bilinear")
    return (1.0 - share * haze / _AIRLIGHT).clamp(min=_LEAST)


def dehazed(images: Float[Tensor, "n 3 h w"], through: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Remove haze of a given transmission from images, RGB in [0, 1]."""
    return ((images - _AIRLIGHT) / through + _AIRLIGHT).clamp(0.0, 1.0)


def certainty(through: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Information of each pixel of a dehazed image, relative to that without haze [1].

    Dehazing amplifies noise by the inverse of the transmission, and information is the inverse of its square.
    """
    return through.square()
