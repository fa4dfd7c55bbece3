"""Image sources other than files and videos: crops of other sources, and topics of ROS bags.

Missing or damaged bags and topics raise `SequenceError`.
"""

import hashlib
import threading
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import cv2
import numpy as np
from jaxtyping import UInt8

from ..decoders import bags
from ..errors import SequenceError
from ..files.decoding import DecodingLimitError, Limits, acquire, release
from ..package_imports import require_package
from .images import ImageSource, decode_image

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""Suffixes of ROS bags; a folder with `metadata.yaml` is also a bag."""
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ogv")
"""Suffixes of video files."""

_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    # ROS names Bayer patterns by the first 2 x 2 pixels, OpenCV by the second and third pixels of the second row.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}
"""Encoding -> channels, and OpenCV's conversion to RGB."""


@dataclass(frozen=True)
class Cropped:
    """Rectangular crop of every image of another source."""

    source: ImageSource
    crop: tuple[int, int, int, int]
    """Left, top, width and height [px]."""

    def name(self, index: int) -> str:
        """Name of the image of frame `index`, for errors."""
        return self.source.name(index)

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Cropped image, RGB; `SequenceError` if the image cannot be read or does not contain the rectangle."""
        image = self.source.read(index)
        left, top, width, height = self.crop
        if left + width > image.shape[1] or top + height > image.shape[0]:
            raise SequenceError(
                f"{self.name(index)} is {image.shape[1]} x {image.shape[0]} pixels, but `crop` extends to "
                f"{left + width} x {top + height}. Correct crop = [left, top, width, height] in the sequence file."
            )
        return np.ascontiguousarray(image[top : top + height, left : left + width])

    def fingerprint(self, index: int) -> str:
        """Fingerprint of the uncropped image and the rectangle."""
        return f"{self.source.fingerprint(index)} {self.crop}"

    def remarks(self) -> tuple[str, ...]:
        """Remarks on the uncropped images."""
        return self.source.remarks()

    def select(self, kept: Sequence[int]) -> "Cropped":
        """Cropped images of these frames."""
        return Cropped(self.source.select(kept), self.crop)


_SECONDS_PER_MIB = 1.0
"""Processor time for decoding a bag [s/MiB], several times that of a bag of joint states only."""


class Bag:
    """Open ROS bag, read in a child process, one call at a time; a context manager.

    Attributes:
        topics: name and message type of each topic.
    """

    def __init__(self, path: Path) -> None:
        require_package("rosbags", "import")
        if not path.exists():
            raise SequenceError(f"bag {path} is missing. Restore it, or correct the path.")
        self.path = path
        self._lock = threading.Lock()
        self._decoder, self._limits = acquire(), Limits.of(path, seconds_per_mib=_SECONDS_PER_MIB)
        self.close = weakref.finalize(self, release, self._decoder)
        self.topics: list[tuple[str, str]] = [(name, kind) for name, kind in self._call(bags.topics)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def rows(self, wanted: dict[str, tuple[str, str]]) -> dict[str, Any]:
        """Logged rows of topics; see `decoders.bags.rows`."""
        return self._call(bags.rows, wanted)

    def image_times(self, topic: str) -> tuple[np.ndarray, np.ndarray]:
        """Record times [ns] and header times [s] of a topic's images."""
        record, stamps = self._call(bags.image_times, topic)
        return record, stamps

    def message(self, topic: str, time: int | None = None) -> Any:
        """Read the message recorded at a time [ns], or the first message; None without such a message."""
        fields = self._call(bags.message, topic, time)
        return None if fields is None else SimpleNamespace(**fields)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            with self._lock:
                return self._decoder.call(function, self.path, *arguments, limits=self._limits)
        except DecodingLimitError as error:
            raise SequenceError(
                f"bag {self.path} was not read: {error}, the limit for a bag of this size. If you trust its origin, "
                "decompress or split it (rosbag decompress, ros2 bag convert), or read it on a faster computer."
            ) from error
        except (OSError, ValueError) as error:
            if self.path.is_file() and (self.path.parent / "metadata.yaml").is_file():
                folder = self.path.parent
                text = f"bag {self.path} is one file of the ROS 2 bag {folder}. Give the folder."
                raise SequenceError(text) from error
            raise SequenceError(
                f"bag {self.path} cannot be read ({error}). It is damaged, truncated or not a ROS bag. Copy it again, "
                "or rebuild its index (rosbag reindex, ros2 bag reindex)."
            ) from error


_SHARED: "weakref.WeakValueDictionary[tuple[Path, int], Bag]" = weakref.WeakValueDictionary()
"""Open bags by path and modification time [ns], shared between cameras."""


class BagImages:
    """Images of one topic of a ROS bag, found by their record times; thread-safe.

    Args:
        path: ROS 1 bag, MCAP file or ROS 2 bag folder.
        topic: topic of type `sensor_msgs/Image` or `sensor_msgs/CompressedImage`.
        times: record time of every frame's message [ns].
    """

    def __init__(self, path: Path, topic: str, times: tuple[int, ...]) -> None:
        self.path = path
        self.topic = topic
        self._times = times
        key = path.absolute(), path.stat().st_mtime_ns if path.exists() else 0
        self._bag = _SHARED.get(key) or _SHARED.setdefault(key, Bag(path))
        names = {name for name, _ in self._bag.topics}
        if topic not in names:
            raise SequenceError(f"bag {path} has no topic {topic!r}. Its topics are: {', '.join(sorted(names))}.")

    def name(self, index: int) -> str:
        """Name of the image of frame `index`, for errors."""
        return f"{self.path}, {self.topic} at {self._times[index]} ns"

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The image of the sequence's frame `index`, RGB; `SequenceError` if it is missing or damaged."""
        return decode_message(self._message(index), self.name(index))

    def fingerprint(self, index: int) -> str:
        """SHA-256 of the message's fields; `SequenceError` if the message is missing."""
        fields = vars(self._message(index))
        data = np.asarray(fields.pop("data"), np.uint8).tobytes()
        return hashlib.sha256(repr(fields).encode() + data).hexdigest()

    def times_of(self, index: int) -> tuple[int, int]:
        """Record time and header stamp of a frame's message [ns]; the record time twice without a stamp."""
        stamp = getattr(self._message(index), "header", {}).get("stamp", {})
        header = int(stamp.get("sec", 0)) * 10**9 + int(stamp.get("nanosec", 0))
        return self._times[index], header or self._times[index]

    def _message(self, index: int) -> Any:
        message = self._bag.message(self.topic, self._times[index])
        if message is None:
            raise SequenceError(f"{self.name(index)}: the message is missing. Import the bag again.")
        return message

    def remarks(self) -> tuple[str, ...]:
        """No remarks: images are used unchanged."""
        return ()

    def select(self, kept: Sequence[int]) -> "BagImages":
        """Messages of these frames."""
        return BagImages(self.path, self.topic, tuple(self._times[index] for index in kept))


def decode_message(message: Any, what: str) -> UInt8[np.ndarray, "height width 3"]:
    """Pixels of a `sensor_msgs` image message, RGB; `SequenceError` if it is damaged or of an unknown encoding."""
    if not hasattr(message, "encoding"):
        return decode_image(np.asarray(message.data, np.uint8).tobytes(), what)
    encoding = message.encoding.lower()
    if encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise SequenceError(
            f"{what} has the encoding {message.encoding!r}. Supported encodings: {known}. Convert the bag."
        )
    channels, conversion = _ENCODINGS[encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    if step < width * channels or len(data) < step * height or not height or not width:
        raise SequenceError(f"{what} has {len(data)} bytes, too few for {width} x {height} pixels of {encoding}.")
    pixels = data[: step * height].reshape(height, step)[:, : width * channels]
    pixels = np.ascontiguousarray(pixels.reshape(height, width, *([channels] if channels > 1 else [])))
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)
