"""Video files as images of a camera: a frame is found by its presentation time, never by counting from a jump."""

import copy
import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import cast

import av.filter
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.sidedata.sidedata import SideData
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import Float, UInt8

from ..errors import SequenceError
from ..wording import counted
from .video_index import decoded_frames, index_video, open_video

SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ogv")
"""File names that are taken for videos."""

_BOTTOM_FIRST = (3, 4)
"""FFmpeg's orders of fields, BB and TB, in which the bottom field is shown first."""
_ONE = 2**16
"""1 in a display matrix."""
_NOT_TURNED = "the file's display matrix turns by no right angle or scales; frames are used as stored."
_KEPT_BYTES = 32 * 2**20
"""Memory for frames as decoded, so that going backwards decodes everything between two key frames only now and then."""


class Video:
    """Frames of one video file by number; safe to use from several threads.

    Decoding begins at the last key frame that is shown no later than the frame asked for, and frames that come out are
    identified by their presentation time. Where seeking does not arrive where it should, decoding begins at an earlier
    key frame; where the container's times are not to be relied on, at the first frame, which is slow and right.

    Frames are turned and mirrored by the file's display matrix, as browsers do. Of interlaced frames the field that is
    shown first is used, with the lines between interpolated; both fields together would show edges twice.

    Args:
        path: the video file.
        numbers: number in the video, from 0 in the order shown, of each of the sequence's frames.
        deinterlace: False uses frames that are marked as interlaced whole, for videos that are marked so by mistake.

    Raises:
        SequenceError: the file is missing, cannot be decoded, or is too short.
    """

    def __init__(self, path: Path, numbers: tuple[int, ...], *, deinterlace: bool = True) -> None:
        self.path = path
        self._numbers = numbers
        self._deinterlace = deinterlace
        self._bottom_first = False
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
        """The image of the sequence's frame `index`, RGB, upright.

        Raises:
            SequenceError: the video is damaged there.
        """
        with self._lock:
            frame = self._frame(self._numbers[index])
            interlaced = self._deinterlace and frame.interlaced_frame
            image = _one_field(frame, bottom=self._bottom_first) if interlaced else _pixels(frame)
            return np.ascontiguousarray(_turned(image, _display_matrix(frame)))

    def remarks(self) -> tuple[str, ...]:
        """What is changed about the frames, by the first of them: turned, deinterlaced, pixels that are not square.

        Raises:
            SequenceError: the video is damaged there.
        """
        with self._lock:
            frame = self._frame(self._numbers[0])
            matrix, stream = _display_matrix(frame), None if self._open is None else self._open[1]
        found = []
        if not np.array_equal(matrix, np.eye(2)):
            mirrored = " and mirrored" if np.linalg.det(matrix) < 0 else ""
            done = f"frames are turned by {abs(frame.rotation)} deg{mirrored}, as the file's display matrix says"
            found.append(f"{done} (calibrations and masks must be of these)." if _is_square(matrix) else _NOT_TURNED)
        if frame.interlaced_frame:
            field = "bottom" if self._bottom_first else "top"
            text = (
                f"one field ({field}) of each is used, with half the rows (change: `deinterlace = false` of the camera)"
            )
            found.append(f"frames are interlaced; {text if self._deinterlace else 'both fields are used'}.")
        aspect = None if stream is None else stream.sample_aspect_ratio
        if aspect is not None and aspect not in (0, 1):
            found.append(
                f"pixels are not square ({aspect.numerator}:{aspect.denominator}); frames are used as stored, and the "
                "calibration must be of stored frames."
            )
        return tuple(found)

    def _frame(self, number: int) -> VideoFrame:
        frame = self._kept.get(number) or self._decode(number)
        if frame is None or frame.is_corrupt:
            raise SequenceError(
                f"video {self.path} ends, or is damaged, at frame number {number} (counted from 0). "
                "Copy it again, or leave the frame out of the sequence."
            )
        return frame

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
        self._bottom_first = stream.codec_context.field_order in _BOTTOM_FIRST
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


def _pixels(frame: VideoFrame) -> UInt8[np.ndarray, "height width 3"]:
    # Without a number of threads swscale starts some for every frame, which takes 20 times as long.
    return frame.to_ndarray(format="rgb24", threads=1)


def _one_field(frame: VideoFrame, *, bottom: bool) -> UInt8[np.ndarray, "height width 3"]:
    """One field of an interlaced frame, its rows where they are in the frame and those between interpolated."""
    graph = av.filter.Graph()
    source = graph.add_buffer(
        width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base or Fraction(1, 1000)
    )
    field, sink = graph.add("field", "bottom" if bottom else "top"), graph.add("buffersink")
    source.link_to(field)
    field.link_to(sink)
    graph.configure()
    source.push(frame)
    rows = _pixels(graph.pull())  # type: ignore[arg-type]
    image = np.empty((frame.height, *rows.shape[1:]), np.uint8)
    first = int(bottom)
    image[first::2] = rows[: len(image[first::2])]
    between = ((rows[:-1].astype(np.uint16) + rows[1:] + 1) // 2).astype(np.uint8)
    image[first + 1 : first + 1 + 2 * len(between) : 2] = between
    image[:first] = rows[:1]
    image[first + 2 * len(rows) - 1 :] = rows[-1]
    return image


def _display_matrix(frame: VideoFrame) -> Float[np.ndarray, "2 2"]:
    """From stored to shown columns and rows, without the shift; the identity for a frame that has none."""
    for entry in cast(Iterable[SideData], frame.side_data):
        if entry.type.name == "DISPLAYMATRIX" and entry.buffer_size == 36:
            values = np.frombuffer(bytes(entry), np.int32).reshape(3, 3)[:2, :2].T
            return values / _ONE
    return np.eye(2)


def _is_square(matrix: Float[np.ndarray, "2 2"]) -> bool:
    """Whether it turns by right angles, and mirrors, and nothing else."""
    return np.array_equal(np.abs(matrix), np.eye(2)) or np.array_equal(np.abs(matrix), np.eye(2)[::-1])


def _turned(image: np.ndarray, matrix: Float[np.ndarray, "2 2"]) -> np.ndarray:
    if not _is_square(matrix):
        return image
    if matrix[0, 0] == 0:
        image = image.swapaxes(0, 1)
    across, down = matrix.sum(axis=1)
    return image[:: int(down), :: int(across)]


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
