"""Headers of encoded images: size, bit depth, transparency and orientation, without decoding."""

import io
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
TIFF = {b"II*\0": "little", b"MM\0*": "big"}
"""Magic numbers and byte order of TIFF."""
LARGEST_IMAGE = 40_000_000
"""Largest number of pixels of an image or video frame; 8K has 33 million."""

_OTHERS = ("TIFF", "BMP", "WEBP", "PPM")
_START_OF_SCAN = 0xDA
_NO_FRAME_HEADER = (0xC4, 0xC8, 0xCC)
"""Markers between 0xC0 and 0xCF that are not frame headers."""
_MOST_SCANS = 200
"""Largest number of scans of a progressive JPEG, each of which is decoded."""
_TIFF_TILE = (322, 323)
_ORIENTATION = 0x0112
_EXIF = b"Exif\0\0"
_ALPHA = (4, 6)
"""PNG colour types with transparency; type 3 is a palette."""
_PALETTE = 3
_MOST_TAGS = 1000
_FAR_TOO_LARGE = (0, LARGEST_IMAGE)


@dataclass(frozen=True)
class ImageTraits:
    """Properties of an encoded image that affect the meaning of its pixels."""

    orientation: int = 1
    """EXIF orientation, 1 to 8; 1 is upright."""
    turned_already: bool = False
    """Whether decoders already apply the orientation, as for TIFF."""
    alpha: bool = False
    palette: bool = False
    lossy: bool = False


def image_traits(content: bytes) -> ImageTraits:
    """Traits of a PNG, JPEG or TIFF image; defaults for other formats and damaged headers."""
    if content.startswith(PNG):
        return _png_traits(content)
    if content.startswith(JPEG):
        return ImageTraits(_jpeg_orientation(content), lossy=True)
    orientation = _tiff_orientation(content) if content[:4] in TIFF else 1
    return ImageTraits(orientation, turned_already=True)


def png_chunks(content: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Type, data start and data end of each PNG chunk; the last chunk may be truncated."""
    begin = len(PNG) + 8
    while begin + 4 <= len(content):
        end = begin + int.from_bytes(content[begin - 8 : begin - 4], "big")
        yield content[begin - 4 : begin], begin, end
        begin = end + 12


def _png_traits(content: bytes) -> ImageTraits:
    kind = content[25] if len(content) > 25 else 0
    orientation = 1
    for name, begin, end in png_chunks(content):
        if name == b"eXIf":
            orientation = _tiff_orientation(content[begin:end])
        elif name == b"tRNS" and kind != _PALETTE:
            kind = 6
    return ImageTraits(orientation, alpha=kind in _ALPHA, palette=kind == _PALETTE)


def _jpeg_orientation(content: bytes) -> int:
    position = 2
    while position + 4 <= len(content) and content[position] == 0xFF and content[position + 1] != _START_OF_SCAN:
        length = int.from_bytes(content[position + 2 : position + 4], "big")
        segment = content[position + 4 : position + 2 + length]
        if content[position + 1] == 0xE1 and segment.startswith(_EXIF):
            return _tiff_orientation(segment[len(_EXIF) :])
        position += 2 + length
    return 1


def _tiff_orientation(content: bytes) -> int:
    """Orientation tag in the first directory of TIFF or EXIF data; 1 if absent."""
    order = TIFF.get(content[:4])
    if order is None:
        return 1

    def number(place: int, length: int) -> int:
        return int.from_bytes(content[place : place + length], order)  # type: ignore[arg-type]

    first = number(4, 4)
    for row in range(min(number(first, 2), _MOST_TAGS)):
        entry = first + 2 + 12 * row
        if number(entry, 2) == _ORIENTATION:
            return value if 1 <= (value := number(entry + 8, 2)) <= 8 else 1
    return 1


def size_problem(content: bytes) -> str | None:
    """Reason to refuse an image, as a clause that follows the file name; None if it can be decoded."""
    size = _size(content)
    if size is None:
        return "cannot be decoded; it must be a JPEG, PNG, TIFF, BMP, WebP or PPM image"
    if size == _FAR_TOO_LARGE:
        return f"is far too large; at most {LARGEST_IMAGE // 10**6} million pixels are read"
    if content.startswith(PNG) and content[24:25] == b"\x10" and 2 * size[0] * size[1] > LARGEST_IMAGE:
        return f"is {size[0]} x {size[1]} pixels of 16 bits; at most {LARGEST_IMAGE // 2 // 10**6} million are read"
    return pixels_problem(*size)


def pixels_problem(width: int, height: int) -> str | None:
    """Reason to refuse an image of this size [px]; None if it can be decoded."""
    if width < 1 or height < 1:
        return f"is {width} x {height} pixels"
    if width * height > LARGEST_IMAGE:
        return f"is {width} x {height} pixels; at most {LARGEST_IMAGE // 10**6} million pixels are read"
    return None


def _size(content: bytes) -> tuple[int, int] | None:
    if content.startswith(PNG):
        # IHDR is always the first chunk.
        header = content[16:24] if content[12:16] == b"IHDR" else b""
        return (int.from_bytes(header[:4], "big"), int.from_bytes(header[4:], "big")) if len(header) == 8 else None
    if content.startswith(JPEG):
        return None if content.count(b"\xff\xda") > _MOST_SCANS else _jpeg_size(content)
    return _other_size(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Width and height in the first frame header, which decoders use."""
    position = 2
    while (position := content.find(b"\xff", position)) >= 0 and position + 9 <= len(content):
        marker = content[position + 1]
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:  # Fill byte, or a marker without payload.
            position += 1 if marker == 0xFF else 2
        elif marker == _START_OF_SCAN:
            return None
        elif 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME_HEADER:
            height, width = content[position + 5 : position + 7], content[position + 7 : position + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        else:
            position += 2 + int.from_bytes(content[position + 2 : position + 4], "big")
    return None


def _other_size(content: bytes) -> tuple[int, int] | None:
    from PIL import Image  # noqa: PLC0415 - most recordings never need it

    # Pillow's warning concerns sizes that exceed our own limit anyway.
    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
    try:
        image = Image.open(io.BytesIO(content), formats=_OTHERS)
        tags = getattr(image, "tag_v2", {})
        tile_width, tile_height = (int(tags.get(tag, 0)) for tag in _TIFF_TILE)
    except Image.DecompressionBombError:  # Pillow does not report the number of pixels in this case.
        return _FAR_TOO_LARGE
    except Exception:  # Pillow propagates any exception of its format readers.
        return None
    # Tiles are decoded completely, even in small images.
    return max(image.width, tile_width), max(image.height, tile_height)
