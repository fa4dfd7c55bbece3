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
_PROBED_FRAMES = 40


class Video:
    """Frames of one video file by number; safe to use from several threads.

    Frames in order are decoded in order. A jump seeks, if seeking in this very file was found to give the same pixels
    as decoding in order does; otherwise the file is decoded again from its start, which is slow and right.

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
        self._seekable: bool | None = None
        if not path.is_file():
            raise SequenceError(f"video {path} is missing. Put it back, or correct the path in the sequence file.")
        count = int(self._open().get(cv2.CAP_PROP_FRAME_COUNT))
        # Containers without an index report no count; such a video shows its length when it is read.
        if 0 < count <= max(numbers):
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

    def _remember(self, number: int, image: np.ndarray) -> None:
        self._cache[number] = image
        while len(self._cache) > _CACHED_FRAMES:
            self._cache.popitem(last=False)

    def _open(self) -> cv2.VideoCapture:
        if self._capture is not None:
            self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path))
        self._next = 0
        if not self._capture.isOpened():
            raise SequenceError(
                f"video {self.path} cannot be decoded. Convert it, say with `ffmpeg -i {self.path.name} -c:v libx264 "
                "-crf 12 converted.mp4`, or into a folder of images."
            )
        return self._capture

    def _decode(self, number: int) -> None:
        capture = self._move_to(number)
        while self._next < number - _KEPT_BEFORE:
            if not capture.grab():
                raise self._ended(number)
            self._next += 1
        # The frames just before are kept as well, so that stepping backwards needs no new jump every time.
        while True:
            ok, image = capture.read()
            if not ok or image is None:
                raise self._ended(number)
            self._remember(self._next, np.ascontiguousarray(image[..., ::-1]))
            self._next += 1
            if self._next > number:
                return

    def _move_to(self, number: int) -> cv2.VideoCapture:
        """Put the decoder somewhere before frame `number`, from where decoding in order reaches it."""
        assert self._capture is not None
        if self._next <= number <= self._next + _SKIP_AT_MOST:
            return self._capture
        if self._seekable is None:
            self._seekable = self._seeks_exactly()
        if self._seekable and self._seek(self._capture, max(number - _KEPT_BEFORE, 0)):
            return self._capture
        return self._open() if self._seekable or number < self._next else self._capture

    def _seek(self, capture: cv2.VideoCapture, number: int) -> bool:
        capture.set(cv2.CAP_PROP_POS_FRAMES, number)
        arrived = round(capture.get(cv2.CAP_PROP_POS_FRAMES)) == number
        if arrived:
            self._next = number
        return arrived

    def _seeks_exactly(self) -> bool:
        """Whether seeking gives the frames that decoding in order gives, tried at the file's beginning."""
        capture = self._open()
        in_order: list[int] = []
        while len(in_order) < _PROBED_FRAMES:
            ok, image = capture.read()
            if not ok:
                break
            in_order.append(zlib.crc32(image.tobytes()))
        last = len(in_order) - 1
        exact = True
        for number in (last * 3 // 4, last // 3, last, 0, last // 2):
            ok, image = capture.read() if self._seek(capture, number) else (False, np.empty(0))
            exact = exact and ok and zlib.crc32(image.tobytes()) == in_order[number]
        self._open()
        return exact

    def _ended(self, number: int) -> SequenceError:
        return SequenceError(
            f"video {self.path} ends, or is damaged, before frame number {number} (counted from 0). "
            "Copy it again, or shorten the kinematics table."
        )
