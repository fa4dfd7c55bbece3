"""Video: the frame that is asked for is the frame that comes, in any order."""

from itertools import islice
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.error import ExitError
from videos import write_video

from carts_core.errors import SequenceError
from carts_core.recording import Sequence
from carts_core.recording.video import Video, _by_packets, _by_table, index_video, open_video

FRAMES = 60
SIZE = (96, 72)


def numbered(number: int) -> np.ndarray:
    """A picture that shows its number as eight black or white bars, so that lossy codecs cannot blur it away."""
    bits = np.array([255 * (number >> bit & 1) for bit in range(8)], np.uint8)
    return np.repeat(np.tile(np.repeat(bits, SIZE[0] // 8), (SIZE[1], 1))[..., None], 3, -1)


def number_of(image: np.ndarray) -> int:
    return sum(int(value > 127) << bit for bit, value in enumerate(image[SIZE[1] // 2, 6::12, 1]))


def write_opencv(path: Path, codec: str, frames: int = FRAMES) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25.0, SIZE)
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {codec} here")
    for number in range(frames):
        writer.write(numbered(number))
    writer.release()
    return path


ORDERS = [range(FRAMES), np.random.default_rng(0).integers(0, FRAMES, 40).tolist(), range(FRAMES - 1, -1, -7)]


@pytest.mark.parametrize(("codec", "suffix"), [("mp4v", ".mp4"), ("MJPG", ".avi"), ("VP80", ".webm"), ("PIM1", ".mpg")])
def test_frames_are_right_in_any_order(tmp_path, codec, suffix):
    path = write_opencv(tmp_path / f"left{suffix}", codec)
    for order in ORDERS:
        video = Video(path, tuple(range(FRAMES)))
        assert [number_of(video.read(index)) for index in order] == list(order)


def test_a_fingerprint_is_of_the_file_and_the_frame(tmp_path):
    video_file = write_opencv(tmp_path / "left.avi", "MJPG", 5)
    video = Video(video_file, tuple(range(5)))
    known = video.fingerprint(1)
    assert known == Video(video_file, (1,)).fingerprint(0) != video.fingerprint(2)
    content = bytearray(video_file.read_bytes())
    content[-1] ^= 1
    video_file.write_bytes(content)
    assert video.fingerprint(1) != known


TIMES = 1500 + np.cumsum(np.random.default_rng(0).choice([20, 40, 90, 200], FRAMES))
"""When the frames of a timed video are shown [ms]: not from 0 on, and not evenly."""

TIMED = {
    "B-frames.mp4": ("libx264", {"bf": "3", "g": "30"}),
    "open-groups.mp4": ("libx264", {"x264-params": "open-gop=1:keyint=12:bframes=3"}),
    "B-frames.mkv": ("libx264", {"bf": "3", "g": "30"}),
    "B-frames.avi": ("mpeg4", {"bf": "2", "g": "30"}),
    "transport-stream.mpg": ("libx264", {"bf": "3", "g": "30"}),
    "hidden-frames.webm": ("libvpx-vp9", {"g": "30", "auto-alt-ref": "1", "lag-in-frames": "16"}),
}


def write_numbered(path: Path, codec: str, options: dict[str, str], times: np.ndarray = TIMES) -> Path:
    """Frame n shows its number from `times[n]` [ms] on."""
    return write_video(path, map(numbered, range(len(times))), codec=codec, options=options, milliseconds=times)


@pytest.fixture(scope="module", params=list(TIMED))
def timed_video(request, tmp_path_factory) -> Path:
    return write_numbered(tmp_path_factory.mktemp("video") / request.param, *TIMED[request.param])


@pytest.mark.parametrize("kept_bytes", [1, 32 * 2**20])
def test_with_reordered_frames_each_is_the_one_asked_for(timed_video, kept_bytes, monkeypatch):
    monkeypatch.setattr("carts_core.recording.video._KEPT_BYTES", kept_bytes)
    video = Video(timed_video, tuple(range(FRAMES)))
    jumps = np.random.default_rng(1).integers(0, FRAMES, 40).tolist()
    order = [FRAMES - 1, *range(0, FRAMES, 3), *range(FRAMES - 1, -1, -5), *jumps]
    assert [number_of(video.read(index)) for index in order] == order


def test_presentation_times_are_those_of_the_file(timed_video):
    timestamps = index_video(timed_video).timestamps
    if timed_video.suffix == ".avi":
        assert timestamps is None or np.allclose(np.diff(timestamps), 0.04)
        return
    assert timestamps is not None
    # The transport stream may delay everything by the encoder's reordering.
    delay = timestamps[0] - TIMES[0] / 1000
    assert timestamps - delay == pytest.approx(TIMES / 1000, abs=1e-3)
    assert abs(delay) < (2.0 if timed_video.suffix == ".mpg" else 1e-3)


def test_frames_that_an_edit_list_cuts_away_are_not_counted(tmp_path):
    path = write_numbered(tmp_path / "cut.mp4", "libx264", {"bf": "0", "g": "30"}, np.arange(-200, 1000, 40))
    with av.open(str(path)) as container:
        expected = [number_of(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert index_video(path).count == len(expected)
    video = Video(path, tuple(range(len(expected))))
    assert [number_of(video.read(index)) for index in range(len(expected))] == expected


@pytest.mark.parametrize(
    ("codec", "options", "times"),
    [
        ("libx264", {"bf": "0", "g": "12"}, TIMES),
        ("libx264", {"bf": "0", "g": "500"}, TIMES),
        ("libx264", {"bf": "0", "g": "1"}, 40 * np.arange(FRAMES)),
        ("mpeg4", {"bf": "0", "g": "30"}, TIMES),
    ],
)
def test_an_mp4_without_reordered_frames_has_the_index_of_its_table(codec, options, times, tmp_path):
    path = write_numbered(tmp_path / "left.mp4", codec, options, times)
    by_table = _by_table(path)
    assert by_table is not None and by_table == _by_packets(path, parsed=True)
    assert by_table == index_video(path) and by_table.count == FRAMES


@pytest.mark.parametrize("flags", ["frag_keyframe+empty_moov", "frag_keyframe", "frag_keyframe+empty_moov+dash"])
def test_frames_of_all_fragments_are_counted(flags, tmp_path):
    path = remuxed(write_numbered(tmp_path / "left.mp4", "libx264", {"bf": "0", "g": "12"}), {"movflags": flags})
    assert index_video(path) == _by_packets(path, parsed=True) and index_video(path).count == FRAMES


def test_frames_whose_pictures_were_cut_off_are_not_counted(tmp_path):
    path = write_numbered(tmp_path / "left.mp4", "libx264", {"bf": "0", "g": "12"})
    path = remuxed(path, {"movflags": "faststart"})
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size * 2 // 3)
    index = index_video(path)
    assert FRAMES // 3 < index.count < FRAMES and index == _by_packets(path, parsed=True)


def remuxed(path: Path, options: dict[str, str]) -> Path:
    """The same packets, written with other options of the container."""
    copy = path.with_stem(path.stem + "-again")
    with av.open(str(path)) as source, av.open(str(copy), "w", options=options) as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream = stream
                target.mux(packet)
    return copy


def test_frames_of_vp8_that_are_only_referred_to_are_not_counted(tmp_path):
    path = write_numbered(tmp_path / "left.webm", "libvpx", {"g": "10", "auto-alt-ref": "0"})
    with av.open(str(path)) as container:
        packets = [(packet.pos or 0, bytes(packet)) for packet in container.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    for number in (3, 25, 48):
        position, packet = packets[number]
        start = content.index(packet, position)
        assert content[start] & 0x10
        content[start] &= ~0x10
    path.write_bytes(content)
    expected = [number for number in range(FRAMES) if number not in (3, 25, 48)]
    assert index_video(path).count == len(expected)
    video = Video(path, tuple(range(len(expected))))
    for index in (56, 24, 2, 3, 46, 45):
        assert number_of(video.read(index)) == expected[index]


def test_a_video_that_seeks_to_the_wrong_frame_is_decoded_from_its_start(tmp_path, monkeypatch):
    path = write_numbered(tmp_path / "left.mp4", "libx264", {"bf": "3", "g": "10"})

    class Inexact:
        """A container whose seeking arrives a group of frames late, as damaged indices make it."""

        def __init__(self, container) -> None:
            self.container = container

        def seek(self, time: int, **options) -> None:
            self.container.seek(time + round(1.0 / options["stream"].time_base), **options)

        def __getattr__(self, name: str):
            return getattr(self.container, name)

    def inexact(path: Path):
        container, stream = open_video(path)
        return Inexact(container), stream

    video = Video(path, tuple(range(FRAMES)))
    monkeypatch.setattr("carts_core.recording.video.open_video", inexact)
    order = [50, 3, 37, 36, 0, 59]
    assert [number_of(video.read(index)) for index in order] == order


def damage(path: Path, number: int) -> None:
    """Overwrite the packet of a frame with zeros."""
    with av.open(str(path)) as container:
        packet = [bytes(packet) for packet in container.demux(video=0) if packet.size][number]
    assert path.read_bytes().count(packet) == 1
    path.write_bytes(path.read_bytes().replace(packet, bytes(len(packet))))


def test_a_damaged_frame_is_an_error_and_the_others_keep_their_numbers(tmp_path):
    path = write_numbered(tmp_path / "left.mkv", "libx264", {"g": "1"}, TIMES[:20])
    damage(path, 9)
    video = Video(path, tuple(range(20)))
    for index in (0, 8, 10, 19, 3):
        assert number_of(video.read(index)) == index
    with pytest.raises(SequenceError, match=r"left.mkv ends or is damaged at frame number 9 \(counted from 0\)"):
        video.read(9)
    assert number_of(video.read(19)) == 19


def test_a_damaged_key_frame_spoils_its_own_group_only(tmp_path):
    path = write_numbered(tmp_path / "left.mkv", "libx264", {"g": "5", "bf": "0", "sc_threshold": "0"}, TIMES[:20])
    damage(path, 10)
    video = Video(path, tuple(range(20)))
    for index in (0, 9, 15, 19, 4):
        assert number_of(video.read(index)) == index
    with pytest.raises(SequenceError, match=r"damaged at frame number 10"):
        video.read(10)
    assert [number for number, _ in video._key_frames] == [0, 5, 15]


def test_a_column_may_say_which_video_frame_a_row_is(tmp_path):
    video = Video(write_opencv(tmp_path / "left.avi", "MJPG"), (50, 20, 40))
    assert [number_of(video.read(index)) for index in (0, 1, 2)] == [50, 20, 40]
    assert video.name(1).endswith("left.avi, frame number 20")


def test_a_video_that_is_too_short_is_refused(tmp_path):
    path = write_opencv(tmp_path / "left.avi", "MJPG", frames=10)
    with pytest.raises(SequenceError, match=r"left.avi has 10 frames, .* frame number 10 .*video_frame"):
        Video(path, tuple(range(11)))


PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nhttp://127.0.0.1:9/left.ts\n#EXT-X-ENDLIST\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is missing"),
        (b"hello" * 1000, "cannot be decoded .*Convert it"),
        pytest.param(PLAYLIST, "cannot be decoded", id="a playlist, from which nothing is fetched"),
    ],
)
def test_what_is_no_video_is_refused(tmp_path, content, message):
    if content:
        (tmp_path / "left.mp4").write_bytes(content)
    with pytest.raises(SequenceError, match=rf"left.mp4 {message}"):
        Video(tmp_path / "left.mp4", (0,))


STALLED = r"left.mkv cannot be read: the disk or network did not answer within .* try again"


def test_a_disk_that_does_not_answer_while_opening_is_named(tmp_path, monkeypatch):
    path = write_numbered(tmp_path / "left.mkv", "libx264", {"g": "10"})
    with monkeypatch.context() as patch:
        patch.setattr("carts_core.recording.video._SECONDS", 1e-9)
        with pytest.raises(SequenceError, match=STALLED):
            index_video(path)
    assert index_video(path).count == FRAMES


def test_a_disk_that_stops_answering_does_not_shorten_the_video(tmp_path, monkeypatch):
    path = write_numbered(tmp_path / "left.mkv", "libx264", {"g": "30", "bf": "0", "sc_threshold": "0"})

    class Stalling:
        """A container whose reading takes too long after some packets."""

        def __init__(self, container) -> None:
            self.container = container

        def demux(self, stream):
            yield from islice(self.container.demux(stream), 15)
            raise ExitError(-1, "Immediate exit requested")

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None:
            self.container.close()

        def __getattr__(self, name: str):
            return getattr(self.container, name)

    def stalling(path: Path, *, parsed: bool = True):
        container, stream = open_video(path, parsed=parsed)
        return Stalling(container), stream

    with monkeypatch.context() as patch:
        patch.setattr("carts_core.recording.video.open_video", stalling)
        with pytest.raises(SequenceError, match=STALLED):
            index_video(path)
    video = Video(path, tuple(range(FRAMES)))
    with monkeypatch.context() as patch:
        patch.setattr("carts_core.recording.video.open_video", stalling)
        with pytest.raises(SequenceError, match=STALLED):
            video.read(25)
    assert [number_of(video.read(index)) for index in (25, 3, 59)] == [25, 3, 59]


@pytest.mark.parametrize("value", ["1.5", "-1"])
def test_a_video_frame_number_must_be_one(tiny_sequence, value):
    path = tiny_sequence(edit=lambda text: text.replace("[kinematics]", '[kinematics]\nvideo_frame = "time"'))
    text = (path.parent / "kinematics.csv").read_text().replace(",0.100,", f",{value},")
    (path.parent / "kinematics.csv").write_text(text)
    with pytest.raises(SequenceError, match=rf"kinematics.csv, line 3, column 'time': {value} is not a frame number"):
        Sequence.open(path)
