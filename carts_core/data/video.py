"""Video files as images of a camera, with seeking that is checked before it is trusted."""

import threading
import zlib
from collections import OrderedDict
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ..errors import SequenceError

SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ogv")
"""File names that are taken for videos."""

_CACHED_FRAMES = 16
_KEPT_BEFORE = 6
_SKIP_AT_MOST = 48


class Video:
    """Frames of one video file by number; safe to use from several threads.

    Frames are decoded in order, and the checksum of each is kept. Only a frame whose checksum is known is jumped to,
    and what arrives is compared with it: many files seek to a neighbour of the frame that was asked for. In such a
    file every jump backwards decodes again from the start, which is slow and right.

    Args:
        path: the video file.
        numbers: number in the video, from 0, of each of the sequence's frames.

    Raises:
        SequenceError: the file is missing, cannot be decoded, or is too short.
    """

    def __init__(self, path: Path, numbers: tuple[int, ...]) -> None:
        self.path = path
        self._numbers = numbers
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()
        self._capture: cv2.VideoCapture | None = None
        self._next = 0
        self._in_order = True
        self._seekable = True
        self._checksums: list[int] = []
        if not path.is_file():
            raise SequenceError(f"video {path} is missing. Put it back, or correct the path in the sequence file.")
        if (count := self._count(max(numbers) + 1)) <= max(numbers):
            raise SequenceError(
                f"video {path} has {count} frames, but the kinematics table asks for frame number {max(numbers)} "
                "(counted from 0). Shorten the table, or give it a column with frame numbers (`video_frame`)."
            )

    def name(self, index: int) -> str:
        """What errors call the image of frame `index`."""
        return f"{self.path}, frame number {self._numbers[index]}"

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The image of the sequence's frame `index`, RGB.

        Raises:
            SequenceError: the video ends earlier or is damaged there.
        """
        number = self._numbers[index]
        with self._lock:
            if number not in self._cache:
                self._decode(number)
            self._cache.move_to_end(number)
            return self._cache[number]

    def _count(self, wanted: int) -> int:
        """How many frames there are, counted only as far as `wanted` and only if the file does not say enough."""
        capture = self._open()
        said = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if said >= wanted:
            return said
        # Files without an index guess their length from the bit rate, and may guess too little.
        count = 0
        while count < wanted and capture.grab():
            count += 1
        self._open()
        return count

    def _remember(self, number: int, image: np.ndarray) -> None:
        self._cache[number] = image
        while len(self._cache) > _CACHED_FRAMES:
            self._cache.popitem(last=False)

    def _open(self) -> cv2.VideoCapture:
        if self._capture is not None:
            self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0
        self._in_order = True
        if not self._capture.isOpened():
            raise SequenceError(
                f"video {self.path} cannot be decoded. Convert it, say with `ffmpeg -i {self.path.name} -c:v libx264 "
                "-crf 12 converted.mp4`, or into a folder of images."
            )
        return self._capture

    def _decode(self, number: int) -> None:
        """Bring frame `number`, and the few before it, into the cache."""
        if self._seek(number) and self._read_until(number):
            return
        # Nothing is known about seeking in this file, or it lied: decoding in order is always right.
        if not (self._in_order and self._next <= number):
            self._open()
        if not self._read_until(number):
            raise SequenceError(
                f"video {self.path} ends, or is damaged, before frame number {number} (counted from 0). "
                "Copy it again, or shorten the kinematics table."
            )

    def _seek(self, number: int) -> bool:
        """Jump back to shortly before a frame that was decoded before; False when it must be reached in order."""
        assert self._capture is not None
        if self._next <= number <= self._next + _SKIP_AT_MOST and (self._in_order or number < len(self._checksums)):
            return True
        if not self._seekable or number >= len(self._checksums):
            return False
        start = max(number - _KEPT_BEFORE, 0)
        self._in_order = False
        self._next = start
        self._seekable = self._capture.set(cv2.CAP_PROP_POS_FRAMES, start)
        return self._seekable

    def _read_until(self, number: int) -> bool:
        """Decode up to and with frame `number`; False when the video ends, or seeking is found not to be exact."""
        assert self._capture is not None
        while self._next <= number:
            ok, image = self._capture.read()
            checksum = zlib.crc32(image.tobytes()) if ok else -1
            if self._in_order and ok and self._next == len(self._checksums):
                self._checksums.append(checksum)
            elif not self._in_order and checksum != self._checksums[self._next]:
                self._seekable = False
                return False
            if not ok:
                return False
            if self._next >= number - _KEPT_BEFORE:
                self._remember(self._next, np.ascontiguousarray(image[..., ::-1]))
            self._next += 1
        return True
