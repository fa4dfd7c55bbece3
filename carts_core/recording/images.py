"""Image files and masks: strict decoding to 8 bits, with a remark on every change, and a cache limited by bytes.

Unusable files raise `SequenceError`; truncated files are rejected, never decoded partially.
"""

import hashlib
import io
import threading
import zlib
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from ..errors import SequenceError
from ..files.reading import (
    IMAGE,
    JPEG,
    PNG,
    TIFF,
    ImageTraits,
    encoded_size,
    image_traits,
    open_regular,
    png_chunks,
    read_bytes,
    size_problem,
)
from .background import evenly_spaced

T = TypeVar("T")


class ByteCache(Generic[T]):
    """Least-recently-used cache with a limit in bytes; thread-safe. Concurrent requests compute a value only once.

    Args:
        limit: memory [bytes]; a single value may be larger.
        size: memory of a value [bytes]; by default values are arrays.
    """

    def __init__(self, limit: int, size: Callable[[Any], int] = attrgetter("nbytes")) -> None:
        self._limit, self._size = limit, size
        self._used = 0
        self._values: OrderedDict[Hashable, T] = OrderedDict()
        self._making: set[Hashable] = set()
        self._changed = threading.Condition()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of `key`, computed by `make` if not cached; if `make` raises, nothing is cached, and waiting
        threads call their own `make`."""
        with self._changed:
            self._changed.wait_for(lambda: key not in self._making)
            if (found := self.find(key)) is not None:
                return found
            self._making.add(key)
        try:
            value = make()
            self.add(key, value)
        finally:
            with self._changed:
                self._making.discard(key)
                self._changed.notify_all()
        return value

    def find(self, key: Hashable) -> T | None:
        """Return the cached value of `key`, or None."""
        with self._changed:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def add(self, key: Hashable, value: T) -> None:
        """Cache a value; beyond the limit, the least recently used values are removed."""
        with self._changed:
            if key in self._values:
                self._used -= self._size(self._values.pop(key))
            self._values[key] = value
            self._used += self._size(value)
            while self._used > self._limit and len(self._values) > 1:
                self._used -= self._size(self._values.popitem(last=False)[1])

    def clear(self) -> None:
        """Remove all values."""
        with self._changed:
            self._values.clear()
            self._used = 0

    def __contains__(self, key: Hashable) -> bool:
        with self._changed:
            return key in self._values


_START_OF_SCAN, _END_OF_IMAGE = b"\xff\xda", b"\xff\xd9"
_REMEDY = "Copy or export it again."
_HEADER = 2**18
"""Number of bytes at the beginning of an image that contain its traits."""
DEPTHS = (8, 10, 12, 14, 16)
"""Bit depths of cameras."""
_SAMPLED, _SAMPLED_MASKS = 12, 2
"""Number of images per camera in which the bit depth is measured, and number of masks checked for remarks, when a
sequence is opened."""
_NEAR = 16
"""Distance from black or white within which values of compressed masks count as black or white."""
_MAX_LABELS = 32
_ONE_COLOUR = 0.35
"""Maximum distance between the colours of one label, relative to their brightest channel."""


class ImageSource(Protocol):
    """Source of the images of one camera in one domain."""

    def name(self, index: int) -> str:
        """Name of the image of frame `index`, for errors."""
        ...

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Recorded image of frame `index`, RGB."""
        ...

    def fingerprint(self, index: int) -> str:
        """Text that changes with the stored image of frame `index`; the image is not decoded."""
        ...

    def remarks(self) -> tuple[str, ...]:
        """Sentences on changes to stored images before they are used: rotation, scaling, deinterlacing."""
        ...

    def select(self, kept: Sequence[int]) -> "ImageSource":
        """Source of the images of these frames."""
        ...


class ImageFiles:
    """Image source with one file per frame.

    Args:
        files: paths of the files.
        bits: bit depth of 16-bit files; by default measured in a sample of the files.
        missing: frames without a file.
    """

    def __init__(self, files: tuple[Path, ...], bits: int | None = None, missing: frozenset[int] = frozenset()) -> None:
        self.files, self.missing = files, missing
        self._present = tuple(file for index, file in enumerate(files) if index not in missing)
        self._given, self._counted = bits, bits

    def name(self, index: int) -> str:
        """Path of the file."""
        return str(self.files[index])

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The decoded file, RGB."""
        return read_image(self.files[index], self.bits)

    def fingerprint(self, index: int) -> str:
        """SHA-256 of the file and, unless it is a JPEG or a PNG of at most 8 bits, of the bit depth."""
        content = read_file(self.files[index])
        eight_bits = content.startswith(JPEG) or (content.startswith(PNG) and content[24:25] != b"\x10")
        return hashlib.sha256(content + (b"" if eight_bits else bytes([self.bits()]))).hexdigest()

    def bits(self) -> int:
        """Bit depth of the images; at least 8."""
        if self._counted is None:
            self._counted = bits_of_files(self._present)
        return self._counted

    def upright(self, index: int) -> bool:
        """Whether the stored pixels are used without an EXIF rotation; also True for an unreadable file."""
        traits = _header(self.files[index])
        return traits is None or traits.orientation == 1

    def remarks(self) -> tuple[str, ...]:
        """Remarks on a sample of the images."""
        bits = () if self._given is not None else bits_remark(self._present)
        return (*image_remarks(spread_files(self._present)), *bits)

    def select(self, kept: Sequence[int]) -> "ImageFiles":
        """Files of these frames."""
        missing = frozenset(place for place, index in enumerate(kept) if index in self.missing)
        return ImageFiles(tuple(self.files[index] for index in kept), self._given, missing)


def read_image(path: Path, bits: Callable[[], int] | None = None) -> UInt8[np.ndarray, "height width 3"]:
    """Read an image file as RGB, rotated by its EXIF orientation; `bits` returns the bit depth of 16-bit files, by
    default the smallest one that contains the values of the image."""
    return _eight_bits(_decode(path, colour=True), f"image {path}", bits)


def decode_image(content: bytes, what: str) -> UInt8[np.ndarray, "height width 3"]:
    """Like `read_image`, for an encoded image in memory."""
    return _eight_bits(_raster(content, what, colour=True), what)


def decode_mask(content: bytes, what: str, largest: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """Pixels other than 0 of an encoded grey or palette image in memory; images above the height and width `largest`
    [px] raise `SequenceError` and are not decoded."""
    size = encoded_size(content)
    if size is not None and (size[0] > largest[1] or size[1] > largest[0]):
        raise SequenceError(f"{what} is {size[0]} x {size[1]} pixels; at most {largest[1]} x {largest[0]} are allowed.")
    raster = _raster(content, what, colour=False)
    values = raster.grey if raster.indices is None else raster.indices
    if values is None:
        raise SequenceError(f"{what} has colours. Save it as a grey image.")
    return values > 0


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """Read a mask file: instruments are white, of one colour, or opaque on transparent; values of at least 128 of 255
    count as white. Label images raise `SequenceError`."""
    raster = _decode(path, colour=False)
    mask = _white_part(raster, f"mask {path}")
    if mask is not None:
        return mask
    image, white = raster.grey, raster.white
    allowed = f"Masks are 0 (background) and {white} (instrument)"
    if image is None:
        raise SequenceError(
            f"mask {path} has several colours. {allowed}. Save only the instrument, or import the labels with "
            "`carts import-masks`."
        )
    if (brightest := image.max()) < 0.5 * white:
        raise SequenceError(
            f"mask {path} has no value above {brightest}. {allowed}. Multiply a mask of 0 and 1 by {white}; of a label "
            "image, save only the label of the instrument."
        )
    values = ", ".join(str(int(value)) for value in _flat_values(image)[:6])
    raise SequenceError(
        f"mask {path} has areas of the values {values}. {allowed}. Save only the labels of the instrument, or import "
        "all labels with `carts import-masks`."
    )


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Label image with a value or a colour per pixel, or mask."""

    mask: Bool[np.ndarray, "height width"] | None
    """Instrument pixels; None for an image with labels."""
    values: np.ndarray | None
    """Grey values in full depth, or palette indices [height, width]; None for colours."""
    colours: UInt8[np.ndarray, "height width 3"]
    """Colour of each pixel, RGB."""
    remarks: tuple[str, ...]
    """Remarks on changes and on the interpretation, as clauses that follow the file's name."""
    lossy: bool = False
    """Whether compression changed the values."""


def read_labels(path: Path) -> LabelImage:
    """Read a label image or mask, in full depth."""
    raster = _decode(path, colour=False)
    grey, remarks = raster.grey, _orientation_remarks([raster.traits])
    mask = _white_part(raster, f"mask {path}")
    if (indices := _label_indices(raster, mask)) is not None:
        grey, mask = indices, None
        remarks.append("labels are palette indices")
    elif raster.opaque is not None:
        remarks.append("the mask is taken from the alpha channel")
    elif grey is not None and mask is not None:
        if mask.any() and grey.max() < raster.white - _NEAR:
            mask = None
        elif ((grey > 0) & (grey < raster.white)).any():
            remarks.append(f"grey borders; values of at least {(raster.white + 1) // 2} are instrument")
    colours = raster.pixels if raster.pixels.ndim == 3 else np.repeat(raster.pixels[..., None], 3, -1)
    colours = colours if colours.dtype == np.uint8 else (colours >> 8).astype(np.uint8)
    return LabelImage(mask, grey, colours, tuple(remarks), raster.traits.lossy)


def mask_remarks(files: Iterable[Path]) -> tuple[str, ...]:
    """Remarks on a sample of the mask files; unreadable files are ignored."""
    found: list[str] = []
    chosen = spread_files([*files], _SAMPLED_MASKS)
    for file in chosen:
        try:
            found += read_labels(file).remarks
        except SequenceError:
            continue
    return tuple(f"masks: {text} ({count} of {len(chosen)} checked)." for text, count in Counter(found).items())


def image_remarks(files: Sequence[Path]) -> tuple[str, ...]:
    """Remarks on images from their headers; missing files are ignored."""
    traits = [each for each in map(_header, files) if each is not None]
    found = [f"images: {text} ({len(traits)} checked)." for text in _orientation_remarks(traits)]
    if any(each.alpha for each in traits):
        found.append("images: transparency (alpha) is not used.")
    return tuple(found)


def _header(file: Path) -> ImageTraits | None:
    """Traits of an image file, from its beginning; None if it cannot be read."""
    try:
        with open_regular(file, IMAGE) as stream:
            return image_traits(stream.read(_HEADER))
    except OSError:
        return None


def bits_remark(files: Sequence[Path]) -> tuple[str, ...]:
    """Remark on the bit depth of 16-bit images; empty for 8-bit images."""
    if not is_deep(files):
        return ()
    bits = bits_of_files(files)
    return (
        f"images: {bits} of 16 bits are used, and values from 0 to {2**bits - 1} are scaled to 8 bits. To change the "
        f"bit depth, set `bits` of the camera in the sequence file to one of {', '.join(map(str, DEPTHS))}.",
    )


def is_deep(files: Sequence[Path]) -> bool:
    """Whether the first of the images has more than 8 bits."""
    try:
        with open_regular(files[0], IMAGE) as stream:
            head = stream.read(25)
        if head.startswith((PNG, JPEG)):
            return head.startswith(PNG) and head[-1] > 8  # Bit depth of the header chunk.
        return _decode(files[0], colour=True).pixels.dtype != np.uint8
    except (SequenceError, OSError, IndexError):
        return False


def bits_of_files(files: Sequence[Path]) -> int:
    """Bit depth in use, measured in a sample of a camera's images; at least 8."""
    largest = 0
    for file in spread_files(files) if is_deep(files) else ():
        try:
            largest = max(largest, int(_decode(file, colour=True).pixels.max()))
        except SequenceError:
            continue
    return _fewest_bits(largest)


def spread_files(files: Sequence[Path], most: int = _SAMPLED) -> list[Path]:
    """Evenly spaced files, from the first to the last."""
    return [files[row] for row in evenly_spaced(len(files), most)]


@dataclass(frozen=True, eq=False)
class _Raster:
    """A decoded image file, upright."""

    pixels: np.ndarray
    """[height, width] or [height, width, 3], RGB, with 8 or 16 bits per channel."""
    opaque: np.ndarray | None
    """Opaque pixels; None if all pixels are opaque."""
    indices: np.ndarray | None
    """Palette indices; None without a palette."""
    traits: ImageTraits

    @property
    def white(self) -> int:
        """Maximum value of the pixel type."""
        return int(np.iinfo(self.pixels.dtype).max)

    @property
    def grey(self) -> np.ndarray | None:
        """Values of an image without colours; None for an image with colours."""
        if self.pixels.ndim == 2:
            return self.pixels
        first = self.pixels[..., :1]
        tolerance = 2 * _NEAR if self.traits.lossy else 0
        same = np.abs(self.pixels.astype(np.int32) - first).max(initial=0) <= tolerance
        return self.pixels[..., 1] if same else None


def _decode(path: Path, *, colour: bool) -> _Raster:
    return _raster(read_file(path), f"image {path}", colour=colour)


def read_file(path: Path) -> bytes:
    """Content of an image file."""
    try:
        return read_bytes(path, IMAGE)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise SequenceError(f"image {path} is missing. Restore it, or correct the path.") from error
    except OSError as error:
        raise SequenceError(f"image {path} cannot be read: {error}.") from error


def _raster(content: bytes, what: str, *, colour: bool) -> _Raster:
    """Pixels of an encoded image."""
    if (damage := find_damage(content)) is not None:
        raise SequenceError(f"{what} is damaged: {damage}. {_REMEDY}")
    if (problem := size_problem(content)) is not None:
        raise SequenceError(f"{what} {problem}. {_REMEDY}")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH if colour else cv2.IMREAD_UNCHANGED
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None and colour and content[:4] in TIFF:
        return _raster(content, what, colour=False)  # Decoded for the error: the pixel type is not 8 or 16 bits.
    if image is None:
        raise SequenceError(f"{what} cannot be decoded; its content is damaged. {_REMEDY}")
    if image.dtype not in (np.uint8, np.uint16):
        raise SequenceError(f"{what} has pixels of the type {image.dtype}. Save it with 8 or 16 bits.")
    traits = image_traits(content)
    indices = None
    if traits.palette and not colour:
        from PIL import Image  # noqa: PLC0415 - OpenCV gives the colours alone

        indices = np.array(Image.open(io.BytesIO(content), formats=("PNG",)))
    if not traits.turned_already:
        image = _TO_UPRIGHT[traits.orientation](image)
        indices = None if indices is None else _TO_UPRIGHT[traits.orientation](indices)
    opaque = None
    if image.ndim == 3:
        white = 255 if image.dtype == np.uint8 else 65535
        if image.shape[2] == 4 and image[..., 3].min() < white:
            opaque = 2 * image[..., 3].astype(np.int64) >= white
        image = image[..., 2::-1]
    return _Raster(np.ascontiguousarray(image), opaque, indices, traits)


_TO_UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.swapaxes(0, 1),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: image.swapaxes(0, 1)[::-1, ::-1],
    8: np.rot90,
}
"""EXIF orientation -> rotation or reflection of the stored image to the upright image."""


def _label_indices(raster: _Raster, mask: np.ndarray | None) -> np.ndarray | None:
    """Palette indices of a label image; None without a palette, for a palette of grey values in their order, and for a
    mask in black and white."""
    indices, grey = raster.indices, raster.grey
    if indices is None or grey is None:
        return indices
    binary = mask is not None and len(np.unique(indices)) <= 2
    return None if binary or np.array_equal(indices, grey) else indices


def _fewest_bits(largest: int) -> int:
    return next(depth for depth in DEPTHS if largest < 2**depth)


def _eight_bits(
    raster: _Raster, what: str, bits: Callable[[], int] | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    if raster.pixels.dtype == np.uint8:
        return raster.pixels
    needed = _fewest_bits(int(raster.pixels.max(initial=0)))
    used = needed if bits is None else bits()
    if needed > used:
        raise SequenceError(
            f"{what} has {needed}-bit values, but the bit depth of its camera is {used}. Set `bits = {needed}` in "
            "the camera's table of the sequence file."
        )
    return (raster.pixels >> (used - 8)).astype(np.uint8)


def _white_part(raster: _Raster, what: str) -> Bool[np.ndarray, "height width"] | None:
    """Instrument pixels of a mask; None for an image of labels."""
    grey = raster.grey
    brightness = raster.pixels.max(-1) if grey is None else grey
    lit = brightness >= 0.5 * raster.white
    if raster.opaque is not None:
        decided = grey is not None and 0 < lit.mean() < 1 and _is_two_valued(grey, raster)
        if decided and not np.array_equal(lit & raster.opaque, raster.opaque | lit):
            raise SequenceError(f"white and opaque pixels of {what} differ. Save it without transparency (alpha).")
        return raster.opaque
    if grey is None:
        hues = raster.pixels[lit] / brightness[lit][:, None]
        if not lit.any() or (np.ptp(hues, axis=0) > _ONE_COLOUR).any():
            return None
    return lit if _is_two_valued(brightness, raster) else None


def _is_two_valued(grey: np.ndarray, raster: _Raster) -> bool:
    """Whether the areas of an image, apart from their borders, are either black or of its maximum brightness."""
    top = int(grey.max())
    flat = _flat_values(grey).astype(np.int64)
    noisy = raster.traits.lossy or len(np.unique(grey)) > _MAX_LABELS
    tolerance = _NEAR if noisy else 0
    near = (flat <= tolerance) | (flat >= top - tolerance)
    black = top <= (_NEAR if raster.traits.lossy else 0)
    return black or (top >= 0.5 * raster.white and bool(near.all()))


def _flat_values(grey: np.ndarray) -> np.ndarray:
    """Values of pixels that are equal to all their neighbours."""
    kernel = np.ones((3, 3), np.uint8)
    return np.unique(grey[cv2.erode(grey, kernel) == cv2.dilate(grey, kernel)])


def _orientation_remarks(traits: Sequence[ImageTraits]) -> list[str]:
    """Remarks on rotated images."""
    rotated = Counter(each.orientation for each in traits if each.orientation != 1)
    return [
        f"{'' if count == len(traits) else f'{count} '}rotated by EXIF orientation {orientation}"
        f"{', which swaps width and height' if orientation > 4 else ''}"
        for orientation, count in sorted(rotated.items())
    ]


def find_damage(content: bytes) -> str | None:
    """Description of the damage of a JPEG or PNG file; None for intact files and other formats.

    OpenCV decodes a truncated JPEG without an error and leaves the missing part grey, so the file is checked.
    """
    if not content:
        return "the file is empty"
    if content.startswith(JPEG):
        # In compressed data a byte 0xff is never followed by 0xd9, so this marker after the last scan ends the image.
        scan = content.rfind(_START_OF_SCAN)
        return None if content.find(_END_OF_IMAGE, scan + 2) > scan >= 0 else "the JPEG ends before its last pixel"
    if not content.startswith(PNG):
        return None
    for kind, begin, end in png_chunks(content):
        if end + 4 > len(content):
            break
        if zlib.crc32(content[begin - 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            return f"the checksum of its {kind.decode('latin-1')} chunk is wrong"
        if kind == b"IEND":
            return None
    return "the PNG ends before its last pixel"
