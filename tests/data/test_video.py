"""Video: the frame that is asked for is the frame that comes, in any order."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.data import Sequence
from carts_core.data.images import read_image
from carts_core.data.video import Video
from carts_core.errors import SequenceError

FRAMES = 150
SIZE = (96, 72)


def numbered(number: int) -> np.ndarray:
    """A picture that shows its number as eight black or white bars, so that lossy codecs cannot blur it away."""
    bits = np.array([255 * (number >> bit & 1) for bit in range(8)], np.uint8)
    return np.repeat(np.tile(np.repeat(bits, SIZE[0] // 8), (SIZE[1], 1))[..., None], 3, -1)


def number_of(image: np.ndarray) -> int:
    return sum(int(value > 127) << bit for bit, value in enumerate(image[SIZE[1] // 2, 6::12, 1]))


def write_video(path: Path, codec: str, frames: int = FRAMES) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25.0, SIZE)
    if not writer.isOpened():
        pytest.skip(f"OpenCV cannot write {codec} here")
    for number in range(frames):
        writer.write(numbered(number))
    writer.release()
    return path


@pytest.fixture(
    params=[("mp4v", ".mp4"), ("MJPG", ".avi"), ("VP80", ".webm"), ("PIM1", ".mpg")], ids=lambda param: param[0]
)
def video_file(request, tmp_path):
    codec, suffix = request.param
    return write_video(tmp_path / f"left{suffix}", codec)


def test_frames_in_order_are_right(video_file):
    video = Video(video_file, tuple(range(FRAMES)))
    assert [number_of(video.read(index)) for index in range(FRAMES)] == list(range(FRAMES))


def test_frames_in_any_order_are_right(video_file):
    video = Video(video_file, tuple(range(FRAMES)))
    order = np.random.default_rng(0).integers(0, FRAMES, 40).tolist()
    assert [number_of(video.read(index)) for index in order] == order


def test_frames_backwards_are_right(video_file):
    video = Video(video_file, tuple(range(FRAMES)))
    order = list(range(FRAMES - 1, -1, -7))
    assert [number_of(video.read(index)) for index in order] == order


def test_a_video_that_seeks_to_the_wrong_frame_is_decoded_from_its_start(tmp_path, monkeypatch):
    path = write_video(tmp_path / "left.mp4", "mp4v")

    class Inexact:
        """A capture whose seeking arrives one frame late and claims to be right, as some files make it."""

        def __init__(self, name: str) -> None:
            self.capture = real(name)
            self.shift = 0

        def set(self, key: int, value: float) -> bool:
            self.shift = 1
            return self.capture.set(key, value + 1)

        def get(self, key: int) -> float:
            return self.capture.get(key) - (self.shift if key == cv2.CAP_PROP_POS_FRAMES else 0)

        def __getattr__(self, name: str):
            return getattr(self.capture, name)

    real = cv2.VideoCapture
    monkeypatch.setattr("carts_core.data.video.cv2.VideoCapture", Inexact)
    video = Video(path, tuple(range(FRAMES)))
    order = [140, 3, 77, 76, 0, 149]
    assert [number_of(video.read(index)) for index in order] == order


def test_a_column_may_say_which_video_frame_a_row_is(tmp_path):
    video = Video(write_video(tmp_path / "left.avi", "MJPG"), (100, 20, 60))
    assert [number_of(video.read(index)) for index in (0, 1, 2)] == [100, 20, 60]
    assert video.name(1).endswith("left.avi, frame number 20")


def test_a_video_that_is_too_short_is_refused(tmp_path):
    path = write_video(tmp_path / "left.avi", "MJPG", frames=10)
    with pytest.raises(SequenceError, match=r"left.avi has 10 frames, .* asks for frame number 10 .*video_frame"):
        Video(path, tuple(range(11)))


def test_a_missing_video_is_named(tmp_path):
    with pytest.raises(SequenceError, match=r"video .*left.mp4 is missing"):
        Video(tmp_path / "left.mp4", (0,))


def test_a_file_that_is_no_video_is_refused(tmp_path):
    path = tmp_path / "left.mp4"
    path.write_bytes(b"hello" * 1000)
    with pytest.raises(SequenceError, match=r"left.mp4 cannot be decoded. Convert it"):
        Video(path, (0,))


def test_a_truncated_video_is_an_error_where_it_ends(tmp_path):
    path = write_video(tmp_path / "left.avi", "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SequenceError, match=r"left.avi"):
        Video(path, tuple(range(FRAMES))).read(FRAMES - 1)


def test_a_sequence_can_be_made_of_a_video(tiny_sequence):
    def as_video(text: str) -> str:
        return text.replace('images = "{domain}/{camera}/{frame}.png"', 'images = "{domain}/{camera}.avi"')

    path = tiny_sequence(edit=lambda text: text)
    expected = Sequence.open(path).frame(2).images["left"]
    writer = cv2.VideoWriter(str(path.parent / "regular/left.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
    for row in (1, 2, 3):
        writer.write(np.ascontiguousarray(read_image(path.parent / f"regular/left/{row:03d}.png")[..., ::-1]))
    writer.release()
    path.write_text(as_video(path.read_text()))
    image = Sequence.open(path).frame(2).images["left"]
    assert np.abs(image.astype(int) - expected).mean() < 4


@pytest.mark.parametrize("value", ["1.5", "-1"])
def test_a_video_frame_number_must_be_one(tiny_sequence, value):
    path = tiny_sequence(edit=lambda text: text.replace("[kinematics]", '[kinematics]\nvideo_frame = "time"'))
    text = (path.parent / "kinematics.csv").read_text().replace(",0.100,", f",{value},")
    (path.parent / "kinematics.csv").write_text(text)
    with pytest.raises(SequenceError, match=rf"kinematics.csv, line 3, column 'time': {value} is not a frame number"):
        Sequence.open(path)
