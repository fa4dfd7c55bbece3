"""Smoke and haze taken off images before anything looks at them.

A veil adds a grey that varies slowly over the image and takes contrast in the same measure. Tissue reflects little
in at least one colour, so the darkest colour of the darkest pixel nearby tells how much has been added: the dark
channel prior of He, Sun and Tang, "Single Image Haze Removal Using Dark Channel Prior" (CVPR 2009).
"""

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ..losses import attention
from .inputs import smoothed

_REACH = 1 / 32
"""How far away the darkest pixel may be, and deviation by which the veil is smoothed [image widths]."""

_COARSER = 4
"""How many times smaller than the images the veil is sought [1]."""

_AIRLIGHT = 0.75
"""Value of a veil that nothing shines through, in every colour [1]."""

_LEAST = 0.25
"""Least transmission that is assumed; noise grows by its inverse [1]."""


def unveiled(images: Float[Tensor, "n 3 h w"], share: float) -> Float[Tensor, "n 3 h w"]:
    """Images without a share of the veil that lies over them.

    Args:
        images: RGB in [0, 1].
        share: of the veil that is taken off [1]; 0 leaves the images as they are.
    """
    if share == 0:
        return images
    darkest = functional.interpolate(images.amin(1, keepdim=True), scale_factor=1 / _COARSER, mode="area")
    reach = max(round(_REACH * darkest.shape[-1]), 1)
    veil = smoothed(-attention(-darkest, reach), reach)
    veil = functional.interpolate(veil, images.shape[-2:], mode="bilinear")
    transmission = (1.0 - share * veil / _AIRLIGHT).clamp(min=_LEAST)
    return ((images - _AIRLIGHT) / transmission + _AIRLIGHT).clamp(0.0, 1.0)
