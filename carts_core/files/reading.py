"""Reading of untrusted files: regular files of limited size and limited nesting, and headers of encoded images.

Recordings, robots and weights are untrusted, and are read only through this module. Links are followed, since data are
often linked. Devices, pipes and sockets are refused, as are files above the size limit of their kind.
"""

import configparser
import io
import json
import math
import os
import re
import stat
import tomllib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from io import BufferedReader
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import msgspec

from ..errors import CartsError
from ..package_imports import gc_paused, require_package
from ..wording import shortened

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
TIFF = {b"II*\0": "little", b"MM\0*": "big"}
"""Magic numbers and byte order of TIFF."""
MAX_IMAGE_PIXELS = 40_000_000
"""Maximum number of pixels of an image or video frame; 8K has 33 million."""

_OTHERS = ("TIFF", "BMP", "WEBP", "PPM")
_START_OF_SCAN = 0xDA
_NO_FRAME_HEADER = (0xC4, 0xC8, 0xCC)
"""Markers between 0xC0 and 0xCF that are not frame headers."""
_MAX_SCANS = 200
"""Maximum number of scans of a progressive JPEG, since every scan is decoded."""
_TIFF_TILE = (322, 323)
_ORIENTATION = 0x0112
_EXIF = b"Exif\0\0"
_ALPHA = (4, 6)
"""PNG colour types with transparency; type 3 is a palette."""
_PALETTE = 3
_MAX_TAGS = 1000
_FAR_TOO_LARGE = (0, MAX_IMAGE_PIXELS)


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
    """Traits of a PNG, JPEG or TIFF image; an image of another format or with a damaged header counts as upright."""
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
    for row in range(min(number(first, 2), _MAX_TAGS)):
        entry = first + 2 + 12 * row
        if number(entry, 2) == _ORIENTATION:
            return value if 1 <= (value := number(entry + 8, 2)) <= 8 else 1
    return 1


def size_problem(content: bytes) -> str | None:
    """Reason to refuse an image, as a clause that follows the file name; None if it can be decoded."""
    size = encoded_size(content)
    if size is None:
        return "cannot be decoded; it must be a JPEG, PNG, TIFF, BMP, WebP or PPM image"
    if size == _FAR_TOO_LARGE:
        return f"is too large; the limit is {MAX_IMAGE_PIXELS // 10**6} million pixels"
    if content.startswith(PNG) and content[24:25] == b"\x10" and 2 * size[0] * size[1] > MAX_IMAGE_PIXELS:
        return (
            f"is {size[0]} x {size[1]} pixels of 16 bits; the limit is {MAX_IMAGE_PIXELS // 2 // 10**6} million pixels"
        )
    return pixels_problem(*size)


def pixels_problem(width: int, height: int) -> str | None:
    """Reason to refuse an image of this size [px]; None if it can be decoded."""
    if width < 1 or height < 1:
        return f"is {width} x {height} pixels"
    if width * height > MAX_IMAGE_PIXELS:
        return f"is {width} x {height} pixels; the limit is {MAX_IMAGE_PIXELS // 10**6} million pixels"
    return None


def encoded_size(content: bytes) -> tuple[int, int] | None:
    """Width and height in the header of an encoded image; None if they cannot be read."""
    if content.startswith(PNG):
        # IHDR is always the first chunk.
        header = content[16:24] if content[12:16] == b"IHDR" else b""
        return (int.from_bytes(header[:4], "big"), int.from_bytes(header[4:], "big")) if len(header) == 8 else None
    if content.startswith(JPEG):
        return None if content.count(b"\xff\xda") > _MAX_SCANS else _jpeg_size(content)
    return _other_size(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Width and height in the first frame header, which decoders use."""
    position = 2
    while (position := content.find(b"\xff", position)) >= 0 and position + 9 <= len(content):
        marker = content[position + 1]
        if marker in (0x00, 0x01, 0xFF) or 0xD0 <= marker <= 0xD8:  # This is a fill byte, or a marker without payload.
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

    # Pillow warns about sizes that exceed the limit of this module anyway.
    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
    try:
        image = Image.open(io.BytesIO(content), formats=_OTHERS)
        tags = getattr(image, "tag_v2", {})
        tile_width, tile_height = (int(tags.get(tag, 0)) for tag in _TIFF_TILE)
    except Image.DecompressionBombError:  # Pillow does not report the number of pixels in this case.
        return _FAR_TOO_LARGE
    except Exception:  # Pillow propagates any exception of its format readers.
        return None
    # Tiles are decoded completely, even for small images.
    return max(image.width, tile_width), max(image.height, tile_height)


T = TypeVar("T")

MIB = 2**20
GIB = 2**30
MAX_DEPTH = 32
"""Maximum nesting depth of TOML, JSON and YAML."""
MAX_YAML_EVENTS = 500_000
"""Maximum number of YAML events: values, and starts and ends of lists and mappings."""
MAX_JSON_PARTS = 3_000_000
"""Maximum number of lists and objects in JSON."""
MAX_INI_LINES = 10_000
MAX_NAME_LENGTH = 255
"""Maximum length of the name of a file or folder [bytes]."""
MAX_PATH_LENGTH = 4096
"""Maximum length of a path [bytes]."""
MAX_INTEGER = 2**63 - 1


@dataclass(frozen=True)
class Kind:
    """File kind with its size limit."""

    name: str
    limit: int
    """Size limit [bytes]."""


SEQUENCE = Kind("sequence file", MIB)
VALUES = Kind("JSON file", 64 * MIB)
TABLE = Kind("table", 256 * MIB)
IMAGE = Kind("image", 256 * MIB)
LABELS = Kind("label file", 16 * MIB)
CALIBRATION = Kind("calibration", 4 * MIB)
SETTINGS = Kind("settings file", MIB)
ROBOT = Kind("URDF", 16 * MIB)
MESH = Kind("mesh", 128 * MIB)
WEIGHTS = Kind("weights file", 512 * MIB)
_POINTER = b"version https://git-lfs"
"""First bytes of a Git LFS pointer, the placeholder for a file that was not fetched."""
_MAX_POINTER_BYTES = 1024
"""Maximum size of a pointer [bytes]."""
_POINTER_TEXT = "it is a Git LFS pointer without its content; run `git lfs pull` in its repository"
BAG = Kind("ROS bag", 1024 * GIB)
VIDEO = Kind("video", 1024 * GIB)
CACHED = Kind("cached mesh", 256 * MIB)


class RefusedFileError(CartsError, OSError):
    """Raised for a path that is a pipe, socket or device, for a file that is too large, and for an invalid name.

    It is also an `OSError`, so that callers handle it like a missing file.
    """


class LfsPointerError(RefusedFileError):
    """Raised for a Git LFS pointer whose content was not fetched."""


def is_regular(path: Path) -> bool:
    """Whether the path is a regular file, directly or through links; False for invalid names."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False


def open_regular(path: Path, kind: Kind) -> BufferedReader:
    """Open a regular file for reading; opening pipes and devices neither blocks nor has side effects.

    Raises:
        FileNotFoundError, IsADirectoryError, OSError: as raised by the system.
        RefusedFileError: the path is not a regular file, the file is too large, or the name is invalid.
    """
    return os.fdopen(_opened(path, kind)[0], "rb")


def _opened(path: Path | str, kind: Kind, folder: int | None = None) -> tuple[int, int]:
    """Descriptor and size [bytes] of a regular file, given by its path or by its name in an open folder, where links
    are refused; errors as in `open_regular`.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY | (0 if folder is None else os.O_NOFOLLOW)
    try:
        descriptor = os.open(path, flags, dir_fd=folder)
    except ValueError as error:  # The name contains a null character.
        raise RefusedFileError(f"this is not a valid file name ({error})") from error
    try:
        status = os.fstat(descriptor)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError(f"{path} is a folder")
        if not stat.S_ISREG(status.st_mode):
            raise RefusedFileError("it is a pipe, socket or device, not a regular file")
        if status.st_size > kind.limit:
            raise _too_large(kind, f"is {status.st_size / MIB:.0f} MiB")
        if status.st_size <= _MAX_POINTER_BYTES and os.pread(descriptor, len(_POINTER), 0) == _POINTER:
            raise LfsPointerError(_POINTER_TEXT)
        return descriptor, status.st_size
    except BaseException:
        os.close(descriptor)
        raise


def check_regular(path: Path, kind: Kind) -> None:
    """Apply the checks of `open_regular` to a file that a library opens by its path."""
    open_regular(path, kind).close()


def read_bytes(path: Path | str, kind: Kind, folder: int | None = None) -> bytes:
    """Read a file; errors are those of `open_regular`.

    Args:
        path: path of the file; with `folder`, its name.
        kind: kind of the file.
        folder: open folder of the file, in which links are refused; None for any path.
    """
    descriptor, size = _opened(path, kind, folder)
    try:
        content = os.read(descriptor, size + 1)  # Reading allocates memory of the requested size.
        if len(content) != size:
            with os.fdopen(descriptor, "rb", closefd=False) as file:
                file.seek(0)
                content = file.read(size + 1)
                if len(content) > size:
                    content += file.read(kind.limit + 1 - len(content))
    finally:
        os.close(descriptor)
    if len(content) > kind.limit:
        raise _too_large(kind, "grew while it was read")
    return content


def read_text(path: Path, kind: Kind) -> str:
    """Read a UTF-8 file without byte order mark; line ends are `\n`.

    Raises:
        FileNotFoundError, IsADirectoryError, OSError, RefusedFileError: as `open_regular`.
        UnicodeDecodeError: the file is not UTF-8.
    """
    return read_bytes(path, kind).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML to dictionaries and lists; `ValueError` for invalid TOML, or if the limits of this module are
    exceeded."""
    # Time and memory of the parser grow quadratically with the number of parts of a key, so long keys are refused
    # first.
    if _LONG_KEY.search(text):
        raise ValueError(f"a dotted key has more than {MAX_DEPTH} parts")
    try:
        values = tomllib.loads(text)
    except RecursionError as error:
        raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep") from error
    _check_values(values)
    return values


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """Parse JSON to dictionaries and lists.

    Args:
        text: content of the file.
        finite: refuse `NaN` and `Infinity`.

    Raises:
        ValueError: the text is not JSON, or exceeds the limits of this module.
    """
    parts = text.count("[") + text.count("{") if isinstance(text, str) else text.count(b"[") + text.count(b"{")
    if parts > MAX_JSON_PARTS:
        raise ValueError(f"it has more than {MAX_JSON_PARTS:,} arrays and objects")
    try:
        with gc_paused():
            values = json.loads(text)
            _check_values(values)
            if finite and not all_finite(values):
                raise ValueError("a number in it is not finite")
    except RecursionError as error:
        raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep") from error
    return values


def parse_yaml(text: str) -> Any:
    """Parse YAML to dictionaries, lists, numbers and strings; dates and sexagesimal numbers stay strings.

    Raises:
        ValueError: the text is not YAML, has aliases or merge keys, or exceeds the limits of this module.
        CartsError: the YAML package is not installed.
    """
    require_package("yaml", "import")
    import yaml  # noqa: PLC0415

    parser: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        depth = 0
        for count, event in enumerate(yaml.parse(text, Loader=parser)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.DocumentStartEvent) and event.tags:
                raise ValueError("it has %TAG directives, which are not supported")
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"it has the alias *{event.anchor}; aliases are not supported, so write the value out")
            if depth > MAX_DEPTH:
                raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep")
            if count > MAX_YAML_EVENTS:
                raise ValueError(f"it has more than {MAX_YAML_EVENTS:,} values")
        values = yaml.load(text, Loader=_plain_yaml(parser))
    except ValueError:
        raise
    except Exception as error:  # value constructors raise many types of exceptions
        raise ValueError(shortened(" ".join(str(error).split()))) from error
    _check_values(values)
    return values


@cache
def _plain_yaml(parser: Any) -> Any:
    """Create a loader that rejects merge keys and parses numbers in linear time."""

    class PlainLoader(parser):
        def flatten_mapping(self, node: Any) -> None:
            """Leave merge keys unresolved, so that they raise an error for lack of a constructor."""

    def whole(loader: Any, node: Any) -> int | str:
        text = loader.construct_scalar(node).replace("_", "")
        octal = re.fullmatch(r"([-+]?)0([0-7]+)", text)
        return text if ":" in text else int("{}0o{}".format(*octal.groups()) if octal else text, 0)

    def real(loader: Any, node: Any) -> float | str:
        text = loader.construct_scalar(node).replace("_", "")
        return text if ":" in text else float(re.sub(r"\.(?=inf|nan)", "", text.lower()))

    PlainLoader.add_constructor("tag:yaml.org,2002:int", whole)
    PlainLoader.add_constructor("tag:yaml.org,2002:float", real)
    PlainLoader.add_constructor("tag:yaml.org,2002:timestamp", parser.construct_yaml_str)
    return PlainLoader


def parse_xml(text: str) -> ElementTree.Element:
    """Parse XML and return the root; `ValueError` for invalid XML, and for document types and entities."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares a document type or entities")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not XML ({error})") from error


def parse_ini(text: str) -> configparser.ConfigParser:
    """Parse INI without interpolation; `ValueError` for invalid INI and more than `MAX_INI_LINES` lines."""
    if text.count("\n") > MAX_INI_LINES:
        raise ValueError(f"it has more than {MAX_INI_LINES:,} lines")
    parser = configparser.ConfigParser(inline_comment_prefixes=(";", "#"), interpolation=None)
    try:
        # The time of the parser grows quadratically with the length of a run of blanks.
        parser.read_string(re.sub(r"[^\S\n]+", " ", text))
    except configparser.Error as error:
        raise ValueError(shortened(" ".join(error.message.split()))) from error
    return parser


def typed(value: Any, kind: type[T]) -> T:
    """Convert a value from `parse_json` or `parse_toml` to a dataclass or another type; `ValueError` names the wrong
    field.
    """
    try:
        return msgspec.convert(value, kind, dec_hook=_path)
    except (msgspec.ValidationError, OverflowError) as error:
        raise ValueError(str(error)) from error


def typed_json(content: bytes, kind: type[T]) -> T:
    """Parse JSON to a dataclass or another type without `Any`; `ValueError` if it is not JSON of this type. Faster than
    `typed(parse_json(...))`, whose limits the type makes unnecessary: it bounds the depth, and numbers are finite."""
    try:
        return _decoder(kind).decode(content)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(str(error)) from error


@cache
def _decoder(kind: type[T]) -> msgspec.json.Decoder[T]:
    return msgspec.json.Decoder(kind, dec_hook=_path)


def _path(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"Expected `{kind.__name__}`, got `{type(value).__name__}`")


def all_finite(root: Any) -> bool:
    """Whether all numbers in a parsed TOML or JSON value are finite."""
    if isinstance(root, dict):
        return all(map(all_finite, root.values()))
    if isinstance(root, list):
        return all(map(all_finite, root))
    return not isinstance(root, float) or math.isfinite(root)


def check_path(path: str | Path) -> None:
    """Check the lengths of a path and of its components; `ValueError` for excessive lengths."""
    text = str(path)
    if len(text) <= MAX_NAME_LENGTH and text.isascii():
        return
    data = os.fsencode(text)
    if len(data) > MAX_PATH_LENGTH or any(len(part) > MAX_NAME_LENGTH for part in data.split(b"/")):
        raise ValueError(f"a name is longer than {MAX_NAME_LENGTH} bytes, or the path is longer than {MAX_PATH_LENGTH}")


_SURROGATE = re.compile("[\ud800-\udfff]")
_KEY_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_KEY_PART}(?:[ \t]*+\.[ \t]*+{_KEY_PART}){{{MAX_DEPTH}}}")


def _check_values(root: Any) -> None:
    """Check nesting depth, integers and strings, level by level without recursion."""
    level = [root]
    for _ in range(MAX_DEPTH + 1):
        deeper: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                deeper += value.keys()
                deeper += value.values()
            elif isinstance(value, list):
                deeper += value
            elif isinstance(value, int) and abs(value) > MAX_INTEGER:
                raise ValueError("an integer has more than 64 bits")
            elif isinstance(value, str) and not value.isascii() and _SURROGATE.search(value):
                raise ValueError("a string has an unpaired surrogate")
        if not deeper:
            return
        level = deeper
    raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep")


def _too_large(kind: Kind, what: str) -> RefusedFileError:
    return RefusedFileError(f"it {what}; the limit for a {kind.name} is {kind.limit // MIB} MiB")
