"""Video files as image sources. Frames are identified by presentation time, never by counting while seeking.

Missing, too short and undecodable videos raise `SequenceError`.
"""

import copy
import hashlib
import threading
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import cast

import av
import av.filter
import numpy as np
from av.container import InputContainer
from av.error import ExitError, FFmpegError
from av.index import IndexEntry
from av.sidedata.sidedata import SideData
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import Float, UInt8

from ..errors import SequenceError
from ..files.reading import MAX_IMAGE_PIXELS, MIB, VIDEO, check_regular, is_regular, open_regular, pixels_problem
from ..wording import counted
from .images import ByteCache

_EXACT = ("mp4", "matroska")
"""Containers with exact presentation times and seeking."""
_COMPLETE = ("mp4",)
"""Exact containers whose packets have complete times and key frame flags."""
_COMPARED = 16
"""Number of positions, and of packets at each position, at which the container's index is compared with the packets."""
_REMEMBERED = 32
_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,matroska,webm,avi,mpeg,mpegts,mpegvideo,asf,ogg",
    "probesize": str(32 * MIB),
    "max_streams": "32",
}
"""Options of FFmpeg: video containers only, since playlists would open other files."""
_SECONDS = 60.0
"""Timeout for opening, and for each read [s]; disks of a network server may need half a minute to start."""


@dataclass(frozen=True)
class VideoIndex:
    """Index of the frames of a video file in presentation order."""

    count: int
    pts: tuple[int, ...] | None
    """Presentation time of every frame in units of `time_base`, increasing; None if unknown."""
    time_base: Fraction
    """Unit of `pts` [s]."""
    key_frames: tuple[tuple[int, int], ...]
    """Frame number and seek time of each key frame; empty if seeking is not exact, so that frames are decoded in order
    from the first."""

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"] | None:
        """Presentation times [s], which need not start at 0; None if unknown."""
        return None if self.pts is None else np.array(self.pts, np.float64) * float(self.time_base)


def index_video(path: Path) -> VideoIndex:
    """Create the index of a video file; cached until the file changes, unless reading it fails."""
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise SequenceError(f"video {path} is missing. Restore it, or correct the path.") from error
    if not is_regular(path):
        raise SequenceError(f"video {path} is a folder, pipe or device. Give a video file.")
    try:
        check_regular(path, VIDEO)
    except OSError as error:
        raise SequenceError(f"video {path} cannot be read: {error}.") from error
    try:
        return _index(path.resolve(), status.st_mtime_ns, status.st_size)
    except ExitError as error:
        raise _stalled(path) from error


def open_video(path: Path, *, parsed: bool = True) -> tuple[InputContainer, VideoStream]:
    """Open a video file; returns the container, a context manager, and its video stream.

    Args:
        path: video file.
        parsed: whether packets are parsed for data missing in the container, which takes as long as reading the
            packets.
    """
    options = _OPTIONS if parsed else {**_OPTIONS, "fflags": "+noparse"}
    try:
        container = av.open(str(path.absolute()), container_options=options, timeout=_SECONDS)
    except ExitError as error:
        raise _stalled(path) from error
    except (FFmpegError, OSError, ValueError) as error:
        raise SequenceError(f"video {path} cannot be decoded ({error}). {_remedy(path)}") from error
    stream = container.streams.best("video")
    if not isinstance(stream, VideoStream) or stream.codec_context is None:  # None for an unknown codec.
        container.close()
        raise SequenceError(f"video {path} cannot be decoded (no video stream with a known codec). {_remedy(path)}")
    if (problem := pixels_problem(stream.width, stream.height)) is not None:
        container.close()
        raise SequenceError(f"video {path} {problem}. {_remedy(path)}")
    # The size can change within a stream.
    stream.codec_context.options = {"max_pixels": str(MAX_IMAGE_PIXELS)}
    stream.thread_type = "AUTO"
    return container, stream


def decoded_frames(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Decode frames from the current position on; damaged frames are skipped. `ExitError` if reading takes longer than
    the timeout."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except ExitError:
            raise
        except (StopIteration, FFmpegError):
            return
        try:
            yield from packet.decode()
        except FFmpegError:
            continue


@lru_cache(maxsize=_REMEMBERED)
def _index(path: Path, modified: int, size: int) -> VideoIndex:
    del modified, size  # Both are part of the cache key.
    index = _by_table(path) or _by_packets(path, parsed=False) or _by_packets(path, parsed=True)
    return _by_decoding(path) if index is None else index


def _by_table(path: Path) -> VideoIndex | None:
    """Create the index from the container's table, without reading all packets; None if the table is not reliable.

    The table has decoding times, which are presentation times only if frames are presented in decoding order. It lacks
    the frames of later fragments, and includes frames that are missing at a truncated end. Therefore the table is
    compared with packets at several positions, and with all packets from the last key frame on.
    """
    container, stream = open_video(path, parsed=False)
    with container:
        complete = any(name in container.format.name for name in _COMPLETE) and not stream.codec_context.has_b_frames
        entries, time_base = tuple(stream.index_entries) if complete else (), stream.time_base
        times = tuple(entry.timestamp for entry in entries)
        keys = [row for row, entry in enumerate(entries) if entry.is_keyframe]
        if not keys or time_base is None or keys[0] != 0 or any(entry.is_discard for entry in entries):
            return None
        if any(earlier >= later for earlier, later in pairwise(times)):
            return None
        some = keys[:-1][:: -(-len(keys) // _COMPARED)]
        if not all(_as_in_table(container, stream, entries[row : row + _COMPARED]) for row in some):
            return None
        if not _as_in_table(container, stream, entries[keys[-1] :], to_end=True):
            return None
    return VideoIndex(len(times), times, time_base, tuple((row, times[row]) for row in keys))


def _as_in_table(
    container: InputContainer, stream: VideoStream, entries: Sequence[IndexEntry], *, to_end: bool = False
) -> bool:
    """Whether the packets match the given entries, from the first entry on."""
    try:
        container.seek(entries[0].timestamp, stream=stream)
        packets = (packet for packet in container.demux(stream) if packet.size)
        found = [
            (packet.pts, packet.dts, packet.pos, packet.size, packet.is_keyframe)
            for packet in islice(packets, len(entries) + to_end)
        ]
    except ExitError:
        raise
    except FFmpegError:
        return False
    return found == [(entry.timestamp, entry.timestamp, entry.pos, entry.size, entry.is_keyframe) for entry in entries]


def _by_packets(path: Path, *, parsed: bool) -> VideoIndex | None:
    """Create the index from the packets; None if their times are not reliable."""
    container, stream = open_video(path, parsed=parsed)
    with container:
        if not parsed and not any(name in container.format.name for name in _COMPLETE):
            return None
        exact = any(name in container.format.name for name in _EXACT)
        vp8 = stream.codec_context.name == "vp8"
        shown: list[int | None] = []
        keys: list[tuple[int | None, int | None]] = []
        try:
            for packet in container.demux(stream):
                if packet.size == 0 or packet.is_discard or (vp8 and not bytes(packet)[0] & 0x10):
                    continue  # The end of the file, frames outside an edit list, or invisible reference frames of VP8.
                shown.append(packet.pts)
                if packet.is_keyframe:
                    keys.append((packet.pts, packet.dts))
        except ExitError:
            raise
        except FFmpegError:
            pass  # The file is truncated here; earlier frames are intact.
        time_base = stream.time_base
    pts = sorted(time for time in shown if time is not None)
    # AVI counts packets instead of pictures; the counts agree only if every frame is a key frame.
    exact |= len(keys) == len(shown)
    if not exact or not pts or len(set(pts)) != len(shown) or time_base is None:
        return None
    number = {time: row for row, time in enumerate(pts)}
    key_frames = sorted((number[pts], pts if dts is None else dts) for pts, dts in keys if pts is not None)
    return VideoIndex(len(pts), tuple(pts), time_base, tuple(key_frames))


def _by_decoding(path: Path) -> VideoIndex:
    """Create the index by decoding the whole file."""
    container, stream = open_video(path)
    with container:
        times = [frame.pts for frame in decoded_frames(container, stream)]
        time_base = stream.time_base or Fraction(1)
    if not times:
        raise SequenceError(f"video {path} cannot be decoded (it has no frames). {_remedy(path)}")
    pts = tuple(time for time in times if time is not None)
    increasing = len(pts) == len(times) and all(a < b for a, b in pairwise(pts))
    return VideoIndex(len(times), pts if increasing else None, time_base, ())


def _stalled(path: Path) -> SequenceError:
    return SequenceError(
        f"video {path} cannot be read: the disk or network did not answer within {_SECONDS:.0f} s. Check them, and try "
        "again."
    )


def _remedy(path: Path) -> str:
    return f"Convert it with `ffmpeg -i {path.name} -c:v libx264 -crf 12 converted.mp4`, or into a folder of images."


_BOTTOM_FIRST = (3, 4)
"""FFmpeg's field orders with the bottom field first: BB and TB."""
_ONE = 2**16
"""Fixed-point 1 in a display matrix."""
_NOT_SQUARE = "the display matrix is not a rotation by a multiple of 90 deg; frames are used as stored."
_KEPT_BYTES = 32 * 2**20
"""Maximum memory for decoded frames, which speeds up stepping backwards [bytes]."""


class Video:
    """Frames of a video file by number; thread-safe.

    Decoding begins at the last key frame presented no later than the requested frame, and decoded frames are identified
    by their presentation time. If seeking is inexact, decoding begins at an earlier key frame; if the container's times
    are unreliable, decoding begins at the first frame, which is slow but exact.

    Frames are rotated and mirrored by the file's display matrix, as in browsers. Only the first field of interlaced
    frames is used, with missing rows interpolated, since both fields together would show edges twice.

    Args:
        path: the video file.
        numbers: number of each frame of the sequence in the video, from 0, in presentation order.
        deinterlace: False uses both fields of frames, for videos that are marked as interlaced by mistake.
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
        self._kept = ByteCache(_KEPT_BYTES, _frame_bytes)
        self._open: tuple[InputContainer, VideoStream] | None = None
        self._frames: Iterator[tuple[int, VideoFrame]] = iter(())
        self._last: int | None = None
        """Number of the last decoded frame; None after a seek."""
        if (count := self._index.count) <= max(numbers):
            raise SequenceError(
                f"video {path} has {counted(count, 'frame')}, but the sequence has frame number {max(numbers)} "
                "(counted from 0). Shorten the table, or add a column of frame numbers (`video_frame`)."
            )

    def name(self, index: int) -> str:
        """Name of the image of frame `index`, for errors."""
        return f"{self.path}, frame number {self._numbers[index]}"

    def read(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """Image of the sequence's frame `index`, RGB, upright; `SequenceError` if the frame is damaged."""
        with self._lock:
            frame = self._frame(self._numbers[index])
            interlaced = self._deinterlace and frame.interlaced_frame
            image = _one_field(frame, bottom=self._bottom_first) if interlaced else _pixels(frame)
            return np.ascontiguousarray(_rotated(image, _display_matrix(frame)))

    def fingerprint(self, index: int) -> str:
        """SHA-256 of the file, with the frame number and whether fields are separated."""
        try:
            status = self.path.stat()
            content = _file_digest(self.path, status.st_mtime_ns, status.st_size)
        except OSError as error:
            raise SequenceError(f"video {self.path} cannot be read: {error}.") from error
        return f"{content} {self._numbers[index]} {self._deinterlace}"

    def select(self, kept: Sequence[int]) -> "Video":
        """Video with these frames."""
        return Video(self.path, tuple(self._numbers[index] for index in kept), deinterlace=self._deinterlace)

    def remarks(self) -> tuple[str, ...]:
        """Remarks on rotation, deinterlacing and non-square pixels, from the first frame."""
        with self._lock:
            frame = self._frame(self._numbers[0])
            matrix, stream = _display_matrix(frame), None if self._open is None else self._open[1]
        found = []
        if not np.array_equal(matrix, np.eye(2)):
            mirrored = " and mirrored" if np.linalg.det(matrix) < 0 else ""
            done = f"frames are rotated by {abs(frame.rotation)} deg{mirrored}, by the display matrix of the file"
            wanted = "Calibrations and masks must refer to rotated frames."
            found.append(f"{done}. {wanted}" if _is_square(matrix) else _NOT_SQUARE)
        if frame.interlaced_frame:
            field = f"only the {'bottom' if self._bottom_first else 'top'} field of each frame is used"
            change = " To use both, set `deinterlace = false` for the camera." if self._deinterlace else ""
            found.append(f"frames are interlaced; {field if self._deinterlace else 'both fields are used'}.{change}")
        aspect = None if stream is None else stream.sample_aspect_ratio
        if aspect is not None and aspect not in (0, 1):
            found.append(
                f"pixels are not square ({aspect.numerator}:{aspect.denominator}); frames are used as stored, and "
                "calibrations must refer to stored frames."
            )
        return tuple(found)

    def _frame(self, number: int) -> VideoFrame:
        try:
            frame = self._kept.find(number) or self._decode(number)
        except ExitError as error:
            # The container remembers the error.
            self._close()
            raise _stalled(self.path) from error
        if frame is None or frame.is_corrupt:
            raise SequenceError(
                f"video {self.path} ends or is damaged at frame number {number} (counted from 0). Copy it again, or "
                "remove the frame from the sequence."
            )
        return frame

    def another(self) -> "Video":
        """Create an independent reader of the same file, with its own position and cache."""
        other = copy.copy(self)
        other._lock, other._kept = threading.Lock(), ByteCache(_KEPT_BYTES // 4, _frame_bytes)
        other._open, other._frames, other._last = None, iter(()), None
        return other

    def _close(self) -> None:
        if self._open is not None:
            self._open[0].close()
        self._open, self._frames, self._last = None, iter(()), None

    def _decode(self, number: int) -> VideoFrame | None:
        """Decode up to frame `number`; None if decoding fails."""
        key, seek_to = self._key_frame_before(number)
        if self._last is None or not key - 1 <= self._last < number:
            while not self._jump(key, seek_to):
                # The key frame is damaged, or seeking is inexact: begin at the previous key frame.
                self._key_frames = tuple(other for other in self._key_frames if other[0] != key)
                key, seek_to = self._key_frame_before(number)
        for position, frame in self._frames:
            self._last = position
            if position >= key:
                # Frames before a key frame may refer to frames that were not decoded.
                self._kept.add(position, frame)
            if position >= number:
                return frame if position == number else None
        self._last = None
        return None

    def _key_frame_before(self, number: int) -> tuple[int, int | None]:
        """Key frame at which decoding begins, and its seek time; None for the beginning of the file."""
        row = bisect_right(self._key_frames, number, key=lambda entry: entry[0])
        return self._key_frames[row - 1] if row > 0 else (0, None)

    def _jump(self, key: int, seek_to: int | None) -> bool:
        """Seek so that frame `key` or an earlier frame is decoded next; False on failure."""
        self._last = None
        if self._open is None or seek_to is None:
            self._close()
            self._open = open_video(self.path)
        container, stream = self._open
        self._bottom_first = stream.codec_context.field_order in _BOTTOM_FIRST
        try:
            if seek_to is not None:
                container.seek(seek_to, stream=stream)
        except ExitError:
            raise
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


@lru_cache(maxsize=_REMEMBERED)
def _file_digest(path: Path, modified: int, size: int) -> str:
    del modified, size  # Both are part of the cache key.
    with open_regular(path, VIDEO) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _pixels(frame: VideoFrame) -> UInt8[np.ndarray, "height width 3"]:
    # By default, swscale starts threads for every frame, which takes 20 times as long.
    return frame.to_ndarray(format="rgb24", threads=1)


def _one_field(frame: VideoFrame, *, bottom: bool) -> UInt8[np.ndarray, "height width 3"]:
    """One field of an interlaced frame at full height, with missing rows interpolated."""
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
    """2x2 matrix of rotation and mirroring from stored to displayed columns and rows; the identity by default."""
    for entry in cast(Iterable[SideData], frame.side_data):
        if entry.type.name == "DISPLAYMATRIX" and entry.buffer_size == 36:
            values = np.frombuffer(bytes(entry), np.int32).reshape(3, 3)[:2, :2].T
            return values / _ONE
    return np.eye(2)


def _is_square(matrix: Float[np.ndarray, "2 2"]) -> bool:
    """Whether the matrix is a combination of right-angle rotations and mirroring."""
    return np.array_equal(np.abs(matrix), np.eye(2)) or np.array_equal(np.abs(matrix), np.eye(2)[::-1])


def _rotated(image: np.ndarray, matrix: Float[np.ndarray, "2 2"]) -> np.ndarray:
    if not _is_square(matrix):
        return image
    if matrix[0, 0] == 0:
        image = image.swapaxes(0, 1)
    across, down = matrix.sum(axis=1)
    return image[:: int(down), :: int(across)]


def _frame_bytes(frame: VideoFrame) -> int:
    return sum(plane.buffer_size for plane in frame.planes)  # YUV, half of RGB
