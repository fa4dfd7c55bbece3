"""Surface maps: what an image shows of the instruments, pixel by pixel, without colours and light.

A surface map has `SURFACE_CHANNELS` channels: which share of a pixel each of `PARTS` covers, in [0, 1], and the mean
unit normal of what covers it times that coverage, in the camera's frame (x right, y down, z forward). Background is
zero throughout. The renderer makes surface maps of a state, and the feature network predicts them of an image.
"""

from .parts import PARTS

COVERAGE = slice(0, len(PARTS))
"""Channels of the coverage per part."""

NORMALS = slice(len(PARTS), len(PARTS) + 3)
"""Channels of the normal."""

SURFACE_CHANNELS = len(PARTS) + 3
