"""Surface maps: what an image shows of the instruments, pixel by pixel, and nothing of how it looks.

A surface map has `SURFACE_CHANNELS` channels: which share of a pixel each of `PARTS` covers, in [0, 1], and the mean
unit normal of what covers it times that coverage, in the camera's frame (x right, y down, z forward). Background is
zero throughout. The renderer makes surface maps of a state, and the feature network predicts them of an image.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from .parts import PARTS

COVERAGE = slice(0, len(PARTS))
"""Channels of the coverage per part."""

NORMALS = slice(len(PARTS), len(PARTS) + 3)
"""Channels of the normal."""

SURFACE_CHANNELS = len(PARTS) + 3


def mirrored(maps: Float[Tensor, "*batch 6 h w"], x: bool, y: bool) -> Float[Tensor, "*batch 6 h w"]:
    """Surface maps of the mirror image; normals turn with it.

    Args:
        maps: surface maps.
        x, y: along which axes of the image it is mirrored.
    """
    turn = maps.new_ones(SURFACE_CHANNELS, 1, 1)
    turn[NORMALS.start] = -1 if x else 1
    turn[NORMALS.start + 1] = -1 if y else 1
    return flipped(maps * turn, x, y)


def flipped(images: Float[Tensor, "*batch h w"], x: bool, y: bool) -> Float[Tensor, "*batch h w"]:
    """Images mirrored along the given axes."""
    return torch.flip(images, [axis for axis, wanted in ((-1, x), (-2, y)) if wanted])
