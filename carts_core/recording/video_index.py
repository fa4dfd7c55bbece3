"""Which frames a video file has, when each is shown, and at which of them decoding may begin. Nothing is decoded for it
where the container says enough."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import islice, pairwise
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.index import IndexEntry
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import Float

from ..errors import SequenceError
from ..files.image_size import LARGEST_IMAGE, pixels_problem
from ..files.reading import MIB, VIDEO, check_regular, is_regular

_EXACT = ("mp4", "matroska")
"""Containers that give every frame its presentation time and find it again."""
_COMPLETE = ("mp4",)
"""Of these, the ones that give every packet its times and say of each whether decoding may begin there."""
_COMPARED = 16
"""Places at most, and packets at each of them, at which the container's table is compared with what the file holds."""
_REMEMBERED = 32
_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,matroska,webm,avi,mpeg,mpegts,mpegvideo,asf,ogg",
    "probesize": str(32 * MIB),
    "max_streams": "32",
}
"""What FFmpeg may open: videos and no playlists, which would make it fetch other files."""
_SECONDS = 10.0
"""Longest wait for opening a file, and for a read of it."""


@dataclass(frozen=True)
class VideoIndex:
    """The frames of a video file in the order in which they are shown."""

    count: int
    pts: tuple[int, ...] | None
    """Presentation time of every frame in units of `time_base`, increasing; None where the file does not say."""
    time_base: Fraction
    """[s]"""
    key_frames: tuple[tuple[int, int], ...]
    """Number of every frame at which decoding may begin, and the time to seek to for it; empty where seeking is not
    exact, so that frames are decoded in order from the first."""

    @property
    def timestamps(self) -> Float[np.ndarray, " frames"] | None:
        """Presentation times [s], as the file gives them: the first is not always 0. None where it gives none."""
        return None if self.pts is None else np.array(self.pts, np.float64) * float(self.time_base)


def index_video(path: Path) -> VideoIndex:
    """The index of a video file; known ones are remembered until the file changes.

    Raises:
        SequenceError: the file is missing or cannot be decoded.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"video {path} is missing. Put it back, or correct the path in the sequence file."
        ) from error
    if not is_regular(path):
        raise SequenceError(f"video {path} is a folder, pipe or device. Name a video file.")
    try:
        check_regular(path, VIDEO)
    except OSError as error:
        raise SequenceError(f"video {path} cannot be read: {error}.") from error
    return _index(path.resolve(), status.st_mtime_ns, status.st_size)


@contextmanager
def opened(path: Path, *, parsed: bool = True) -> Iterator[tuple[InputContainer, VideoStream]]:
    """A video file and its video stream.

    Args:
        path: the file.
        parsed: look into packets for what the container does not say, which takes as long as reading them.

    Raises:
        SequenceError: it cannot be decoded.
    """
    container, stream = open_video(path, parsed=parsed)
    with container:
        yield container, stream


def open_video(path: Path, *, parsed: bool = True) -> tuple[InputContainer, VideoStream]:
    """As `opened`; the caller closes the container."""
    options = _OPTIONS if parsed else {**_OPTIONS, "fflags": "+noparse"}
    try:
        container = av.open(str(path.absolute()), container_options=options, timeout=_SECONDS)
    except (FFmpegError, OSError, ValueError) as error:
        raise SequenceError(f"video {path} cannot be decoded ({error}). {_remedy(path)}") from error
    stream = container.streams.best("video")
    if not isinstance(stream, VideoStream) or stream.codec_context is None:  # None for a codec that nobody knows.
        container.close()
        raise SequenceError(f"video {path} cannot be decoded (it has no video stream). {_remedy(path)}")
    if (problem := pixels_problem(stream.width, stream.height)) is not None:
        container.close()
        raise SequenceError(f"video {path} {problem}. {_remedy(path)}")
    # The size can change within a stream.
    stream.codec_context.options = {"max_pixels": str(LARGEST_IMAGE)}
    stream.thread_type = "AUTO"
    return container, stream


def decoded_frames(container: InputContainer, stream: VideoStream) -> Iterator[VideoFrame]:
    """Frames from where the container stands on; damaged ones are left out."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, FFmpegError):
            return
        try:
            yield from packet.decode()
        except FFmpegError:
            continue


@lru_cache(maxsize=_REMEMBERED)
def _index(path: Path, modified: int, size: int) -> VideoIndex:
    del modified, size  # They are part of the key.
    index = _by_table(path) or _by_packets(path, parsed=False) or _by_packets(path, parsed=True)
    return _by_decoding(path) if index is None else index


def _by_table(path: Path) -> VideoIndex | None:
    """The index from the container's own table, without reading the packets; None where that is not to be relied on.

    The table has decoding times, which are presentation times only where frames are shown in the order in which they
    are decoded; it lacks what a file's later fragments hold, and has what was cut off its end. So packets here and
    there, and all from the last key frame on, are compared with it.
    """
    with opened(path, parsed=False) as (container, stream):
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
    """Whether the packets from the first of these entries on are the ones that the entries tell of."""
    try:
        container.seek(entries[0].timestamp, stream=stream)
        packets = (packet for packet in container.demux(stream) if packet.size)
        found = [
            (packet.pts, packet.dts, packet.pos, packet.size, packet.is_keyframe)
            for packet in islice(packets, len(entries) + to_end)
        ]
    except FFmpegError:
        return False
    return found == [(entry.timestamp, entry.timestamp, entry.pos, entry.size, entry.is_keyframe) for entry in entries]


def _by_packets(path: Path, *, parsed: bool) -> VideoIndex | None:
    """The index as the container gives it, None where that is not to be relied on."""
    with opened(path, parsed=parsed) as (container, stream):
        if not parsed and not any(name in container.format.name for name in _COMPLETE):
            return None
        exact = any(name in container.format.name for name in _EXACT)
        vp8 = stream.codec_context.name == "vp8"
        shown: list[int | None] = []
        keys: list[tuple[int | None, int | None]] = []
        try:
            for packet in container.demux(stream):
                if packet.size == 0 or packet.is_discard or (vp8 and not bytes(packet)[0] & 0x10):
                    continue  # The end, what an edit list cuts away, and VP8's frames that are only referred to.
                shown.append(packet.pts)
                if packet.is_keyframe:
                    keys.append((packet.pts, packet.dts))
        except FFmpegError:
            pass  # The file is cut off here; the frames before are as good as ever.
        time_base = stream.time_base
    pts = sorted(time for time in shown if time is not None)
    # AVI numbers packets, not pictures: the two agree only while every frame stands alone.
    exact |= len(keys) == len(shown)
    if not exact or not pts or len(set(pts)) != len(shown) or time_base is None:
        return None
    number = {time: row for row, time in enumerate(pts)}
    key_frames = sorted((number[pts], pts if dts is None else dts) for pts, dts in keys if pts is not None)
    return VideoIndex(len(pts), tuple(pts), time_base, tuple(key_frames))


def _by_decoding(path: Path) -> VideoIndex:
    """The index of what comes out when the whole file is decoded in order."""
    with opened(path) as (container, stream):
        times = [frame.pts for frame in decoded_frames(container, stream)]
        time_base = stream.time_base or Fraction(1)
    if not times:
        raise SequenceError(f"video {path} cannot be decoded (it has no frames). {_remedy(path)}")
    pts = tuple(time for time in times if time is not None)
    increasing = len(pts) == len(times) and all(a < b for a, b in pairwise(pts))
    return VideoIndex(len(times), pts if increasing else None, time_base, ())


def _remedy(path: Path) -> str:
    return (
        f"Convert it, say with `ffmpeg -i {path.name} -c:v libx264 -crf 12 converted.mp4`, or into a folder of images."
    )
