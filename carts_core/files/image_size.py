"""How many pixels an encoded image has, from its header, so that too large ones are refused before they are decoded."""

import io
import warnings

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
LARGEST_IMAGE = 40_000_000
"""Most pixels of an image or of a video's frame; 8K has 33 million."""

_OTHERS = ("TIFF", "BMP", "WEBP", "PPM")
_START_OF_SCAN = 0xDA
_NO_FRAME_HEADER = (0xC4, 0xC8, 0xCC)
"""Markers among those of frame headers, 0xC0 to 0xCF, that are something else."""
_MOST_SCANS = 200
"""A progressive JPEG is decoded as often as it has scans."""
_TIFF_TILE = (322, 323)
_FAR_TOO_LARGE = (0, LARGEST_IMAGE)


def size_problem(content: bytes) -> str | None:
    """Why an image is not decoded, in words that follow the file's name; None where it may be.

    Args:
        content: of the file: PNG, JPEG, TIFF, BMP, WebP or PPM.
    """
    size = _size(content)
    if size is None:
        return "cannot be decoded; it must be a JPEG, PNG, TIFF, BMP, WebP or PPM image"
    if size == _FAR_TOO_LARGE:
        return f"is far too large; at most {LARGEST_IMAGE // 10**6} million pixels are read"
    return pixels_problem(*size)


def pixels_problem(width: int, height: int) -> str | None:
    """Why an image of this size [px] is not decoded; None where it may be."""
    if width < 1 or height < 1:
        return f"is {width} x {height} pixels"
    if width * height > LARGEST_IMAGE:
        return f"is {width} x {height} pixels; at most {LARGEST_IMAGE // 10**6} million pixels are read"
    return None


def _size(content: bytes) -> tuple[int, int] | None:
    if content.startswith(PNG):
        # The header is always the first chunk.
        header = content[16:24] if content[12:16] == b"IHDR" else b""
        return (int.from_bytes(header[:4], "big"), int.from_bytes(header[4:], "big")) if len(header) == 8 else None
    if content.startswith(JPEG):
        return None if content.count(b"\xff\xda") > _MOST_SCANS else _jpeg_size(content)
    return _other_size(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Width and height in the first frame header, which is the one that decoders take."""
    position = 2
    while (position := content.find(b"\xff", position)) >= 0 and position + 9 <= len(content):
        marker = content[position + 1]
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:  # Filling, or a marker without content.
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

    # Pillow warns of sizes that are beyond our own limit anyway.
    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
    try:
        image = Image.open(io.BytesIO(content), formats=_OTHERS)
        tags = getattr(image, "tag_v2", {})
        tile_width, tile_height = (int(tags.get(tag, 0)) for tag in _TIFF_TILE)
    except Image.DecompressionBombError:  # Pillow does not say how many pixels it has, only that they are far too many.
        return _FAR_TOO_LARGE
    except Exception:  # Pillow raises whatever its format readers raise.
        return None
    # A tile is decoded whole, however small the image.
    return max(image.width, tile_width), max(image.height, tile_height)
