"""Painted layers of a frame, each an 8-bit PNG."""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from ..errors import ProjectError

_ADDED, _REMOVED, _IGNORED = np.uint8(255), np.uint8(127), np.uint8(255)
_UNFILTERED = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
)
_HEADER = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"


@dataclass(frozen=True)
class Layer:
    """Painted layer, created by the method `of` of a subclass; `ProjectError` if the bytes are not a PNG."""

    png: bytes

    def __post_init__(self) -> None:
        if not self.png.startswith(_HEADER) or len(self.png) < len(_HEADER) + 8:
            raise ProjectError("a painted layer is not a PNG image. Create it with `of`.")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px] from the PNG header."""
        return struct.unpack_from(">II", self.png, len(_HEADER))

    def encode(self) -> bytes:
        """Encode the layer for storage."""
        return self.png

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Decode the result of `encode`; `ProjectError` for other bytes."""
        return cls(bytes(data))

    def pixels(self) -> UInt8[np.ndarray, "height width"]:
        """Pixel values of the PNG, read-only; `ProjectError` if it is damaged."""
        return _decoded(self.png, self.size)


class MaskCorrection(Layer):
    """Pixels added to the rendered mask (255) or removed from it (127); 0 elsewhere."""

    @classmethod
    def of(cls, added: Bool[np.ndarray, "height width"], removed: Bool[np.ndarray, "height width"]) -> Self:
        """Create a correction from masks of pixels; `ProjectError` if the shapes differ or a pixel is in both."""
        added, removed = np.asarray(added, bool), np.asarray(removed, bool)
        if added.shape != removed.shape or added.ndim != 2 or (added & removed).any():
            raise ProjectError(
                f"pixels added (shape {added.shape}) and removed ({removed.shape}) must be disjoint masks "
                "of the same size. Remove the pixels of a later stroke from the other mask."
            )
        return cls(_png(added * _ADDED + removed * _REMOVED))

    def added(self) -> Bool[np.ndarray, "height width"]:
        """Arm pixels where no arm is rendered."""
        return self.pixels() == _ADDED

    def removed(self) -> Bool[np.ndarray, "height width"]:
        """Background pixels where an arm is rendered."""
        return self.pixels() == _REMOVED

    def applied_to(self, mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
        """Apply the correction to a mask."""
        pixels = self.pixels()
        return (mask | (pixels == _ADDED)) & (pixels != _REMOVED)


class IgnoreRegion(Layer):
    """Pixels where the arms are occluded (255); 0 elsewhere. The optimizer ignores them."""

    @classmethod
    def of(cls, region: Bool[np.ndarray, "height width"]) -> Self:
        """Create a region from a mask; `ProjectError` if the array is not a mask."""
        region = np.asarray(region, bool)
        if region.ndim != 2:
            raise ProjectError(f"an ignore region has shape {region.shape}. Give a mask [height, width].")
        return cls(_png(region * _IGNORED))

    def region(self) -> Bool[np.ndarray, "height width"]:
        """True where pixels are ignored."""
        return self.pixels() == _IGNORED


class LabelLayer(Layer):
    """Label image; 0 is unlabelled."""

    @classmethod
    def of(cls, labels: UInt8[np.ndarray, "height width"]) -> Self:
        """Create a layer from an 8-bit image of label numbers; `ProjectError` for other arrays."""
        labels = np.asarray(labels)
        if labels.ndim != 2 or labels.dtype != np.uint8:
            raise ProjectError(f"labels are {labels.dtype} {labels.shape}. Give 8 bits per pixel [height, width].")
        return cls(_png(labels))

    def labels(self) -> UInt8[np.ndarray, "height width"]:
        """Label of every pixel; read-only."""
        return self.pixels()


class PartLabels(LabelLayer):
    """Painted part classes (numbers of `carts_core.model.parts.PartClass`)."""


class ImportedMask(LabelLayer):
    """Imported label numbers (see `ImportedLabels`) of the pixels of an image."""

    def mask(self) -> Bool[np.ndarray, "height width"]:
        """Labelled pixels."""
        return self.pixels() > 0


@lru_cache(maxsize=8)
def _decoded(png: bytes, size: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """Decode a PNG; cached, since overlay, scores and panels read a layer several times per stroke."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None or image.shape[::-1] != size:
        raise ProjectError("a painted layer is damaged. Undo to a step before it was painted, or repaint it.")
    image = image.astype(np.uint8, copy=False)
    image.flags.writeable = False
    return image


def _png(pixels: UInt8[np.ndarray, "height width"]) -> bytes:
    """Encode an image as PNG without filters; masks are then encoded and decoded faster."""
    ok, data = cv2.imencode(".png", pixels, _UNFILTERED)
    if not ok:
        raise ProjectError(f"a painted layer of shape {pixels.shape} could not be written as PNG.")
    return data.tobytes()
