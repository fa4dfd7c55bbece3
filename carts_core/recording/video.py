"""Video files as images of a camera: a frame is found by its presentation time, never by counting from a jump."""

import copy
import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import UInt8

from ..errors import SequenceError
from ..wording import counted
from .video_index import decoded_frames, index_video, open_video

SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ogv")
"""File names that are taken for videos."""

_KEPT_BYTES = 32 * 2**20
"""Memory for frames as decoded, so that going backwards decodes everything between two key frames only now and then."""


class Video:
    """Frames of one video file by number; safe to use from several threads.

    Decoding begins at the last key frame that is shown no later than the frame asked for, and frames that come out are
    identified by their presentation time. Where seeking does not arrive where it should, decoding begins at an earlier
    key frame; where the container's times are not to be relied on, at the first frame, which is slow and right.

    Args:
        path: the video file.
        numbers: number in the video, from 0 in the order shown, of each of the sequence's frames.

    Raises:
        SequenceError: the file is missing, cannot be decoded, or is too short.
    """

    def __init__(self, path: Path, numbers: tuple[int, ...]) -> None:
        self.path = path
        self._numbers = numbers
        self._index = index_video(path)
        self._number_of = {time: number for number, time in enumerate(self._index.pts or ())}
        self._key_frames = self._index.key_frames
        self._lock = threading.Lock()
        self._kept = _Kept(_KEPT_BYTES)
        self._open: tuple[InputContainer, VideoStream] | None = None
        self._frames: Iterator[tuple[int, VideoFrame]] = iter(())
        self._last: int | None = None
        """Number of the frame that was decoded last; None before the first after a jump."""
        if (count := self._index.count) <= max(numbers):
            raise SequenceError(
                f"video {path} has {counted(count, 'frame')}, but frame number {max(numbers)} (counted from 0) "
                "is asked for. Shorten the table, or give it a column with frame numbers (`video_frame`)."
            )

    def name(self, index: int) -> str:
        """What errors call the image of frame `index`."""
        return f"{self.path}, frame number {self._numbers[index]}"

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """The image of the sequence's frame `index`, RGB, with the pixels where the file has them.

        Raises:
            SequenceError: the video is damaged there.
        """
        number = self._numbers[index]
        with self._lock:
            frame = self._kept.get(number) or self._decode(number)
            if frame is None or frame.is_corrupt:
                raise SequenceError(
                    f"video {self.path} ends, or is damaged, at frame number {number} (counted from 0). "
                    "Copy it again, or leave the frame out of the sequence."
                )
            # Without a number of threads swscale starts some for every frame, which takes 20 times as long.
            return np.ascontiguousarray(frame.to_ndarray(format="rgb24", threads=1))

    def another(self) -> "Video":
        """A reader of its own of the same file: who jumps about with it does not disturb who reads on with this one."""
        other = copy.copy(self)
        other._lock, other._kept = threading.Lock(), _Kept(_KEPT_BYTES // 4)
        other._open, other._frames, other._last = None, iter(()), None
        return other

    def _decode(self, number: int) -> VideoFrame | None:
        """Decode up to frame `number`; None when it does not come out."""
        key, seek_to = self._key_frame_before(number)
        if self._last is None or not key - 1 <= self._last < number:
            while not self._jump(key, seek_to):
                # The key frame is damaged, or seeking does not arrive where it should: begin at the one before.
                self._key_frames = tuple(other for other in self._key_frames if other[0] != key)
                key, seek_to = self._key_frame_before(number)
        for position, frame in self._frames:
            self._last = position
            if position >= key:
                # Those before a key frame may refer to frames that were not decoded.
                self._kept.add(position, frame)
            if position >= number:
                return frame if position == number else None
        self._last = None
        return None

    def _key_frame_before(self, number: int) -> tuple[int, int | None]:
        """Number of the frame where decoding begins, and the time to seek to, None for the file's start."""
        row = bisect_right(self._key_frames, number, key=lambda entry: entry[0])
        return self._key_frames[row - 1] if row > 0 else (0, None)

    def _jump(self, key: int, seek_to: int | None) -> bool:
        """Stand where frame `key` or an earlier one comes next; False when the file cannot be made to."""
        self._last = None
        if self._open is None or seek_to is None:
            if self._open is not None:
                self._open[0].close()
            self._open = open_video(self.path)
        container, stream = self._open
        try:
            if seek_to is not None:
                container.seek(seek_to, stream=stream)
        except FFmpegError:
            return False
        frames = self._numbered(decoded_frames(container, stream))
        first = next(frames, None)
        self._frames = chain([] if first is None else [first], frames)
        return seek_to is None or (first is not None and first[0] <= key)

    def _numbered(self, frames: Iterator[VideoFrame]) -> Iterator[tuple[int, VideoFrame]]:
        if not self._index.key_frames:
            return enumerate(frames)
        return ((self._number_of[frame.pts], frame) for frame in frames if frame.pts in self._number_of)


class _Kept:
    """The frames that were decoded last, as many as fit into a number of bytes, in YUV, which is half of RGB."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._used = 0
        self._frames: OrderedDict[int, VideoFrame] = OrderedDict()

    def get(self, number: int) -> VideoFrame | None:
        return self._frames.get(number)

    def add(self, number: int, frame: VideoFrame) -> None:
        if (old := self._frames.pop(number, None)) is not None:
            self._used -= _size(old)
        self._frames[number] = frame
        self._used += _size(frame)
        while self._used > self._limit and len(self._frames) > 1:
            self._used -= _size(self._frames.popitem(last=False)[1])


def _size(frame: VideoFrame) -> int:
    return sum(plane.buffer_size for plane in frame.planes)
