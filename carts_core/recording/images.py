"""Image files, decoded strictly: a file that is cut off is an error and not a half grey image."""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from ..errors import SequenceError
from ..files.image_size import JPEG, PNG, size_problem
from ..files.reading import IMAGE, read_bytes

_START_OF_SCAN, _END_OF_IMAGE = b"\xff\xda", b"\xff\xd9"
_REMEDY = "Copy or export it again."


class ImageSource(Protocol):
    """Where the images of one camera in one domain come from."""

    def name(self, index: int) -> str:
        """What errors call the image of frame `index`."""
        ...

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The image of frame `index` as recorded, RGB."""
        ...


@dataclass(frozen=True)
class ImageFiles:
    """An image file per frame."""

    files: tuple[Path, ...]

    def name(self, index: int) -> str:
        """Path of the file."""
        return str(self.files[index])

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The decoded file, RGB.

        Raises:
            SequenceError: it is missing, truncated or not an image.
        """
        return read_image(self.files[index])


def read_image(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """An image file as RGB, with the pixels where the file has them (orientation tags are ignored).

    Raises:
        SequenceError: the file is missing, truncated or not an image.
    """
    # A calibrated camera's pixels may not be turned, whatever the file's tags say.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.ascontiguousarray(image[..., ::-1])


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """A mask file; half of what its pixels can hold (128 of 255) and more is instrument.

    Raises:
        SequenceError: the file is missing, truncated, not an image, or has labels instead of black and white.
    """
    image = _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    white = np.iinfo(image.dtype).max if np.issubdtype(image.dtype, np.integer) else 1
    if 0 < (brightest := image.max()) < 0.5 * white:
        raise SequenceError(
            f"mask {path} has no value above {brightest}. Masks are 0 (background) and {white} (instrument): "
            f"multiply a mask of 0 and 1 by {white}, choose the instrument's label in a label image."
        )
    return image >= 0.5 * white


def _decode(path: Path, flags: int) -> np.ndarray:
    try:
        content = read_bytes(path, IMAGE)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise SequenceError(
            f"image {path} is missing. Put it back, or correct the path in the sequence file."
        ) from error
    except OSError as error:
        raise SequenceError(f"image {path} cannot be read: {error}.") from error
    if (damage := find_damage(content)) is not None:
        raise SequenceError(f"image {path} is damaged: {damage}. {_REMEDY}")
    if (problem := size_problem(content)) is not None:
        raise SequenceError(f"image {path} {problem}. {_REMEDY}")
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise SequenceError(f"image {path} cannot be decoded; its content is damaged. {_REMEDY}")
    return image


def find_damage(content: bytes) -> str | None:
    """What is wrong with a JPEG or PNG file, None when it is whole (or of another kind).

    OpenCV decodes a truncated JPEG without an error and leaves the rest grey, so this looks at the file itself.
    """
    if not content:
        return "the file is empty"
    if content.startswith(JPEG):
        # In compressed data a byte 0xff is never followed by 0xd9, so this marker after the last scan is the end.
        scan = content.rfind(_START_OF_SCAN)
        return None if content.find(_END_OF_IMAGE, scan + 2) > scan >= 0 else "the JPEG ends before its last pixel"
    if content.startswith(PNG):
        return _png_damage(content)
    return None


def _png_damage(content: bytes) -> str | None:
    position = len(PNG)
    while position + 12 <= len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        kind = content[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(content):
            break
        if zlib.crc32(content[position + 4 : end - 4]) != int.from_bytes(content[end - 4 : end], "big"):
            return f"the checksum of its {kind.decode('latin-1')} chunk is wrong"
        if kind == b"IEND":
            return None
        position = end
    return "the PNG ends before its last pixel"
