"""Frames and joint positions with separate clocks: matching with the nearest rows, within a maximum gap."""

import csv
from pathlib import Path

import numpy as np
import pytest
from lab_robots import write_urdf
from videos import write_video

from carts_core.errors import SequenceError
from carts_core.recording import Sequence

ROWS = np.arange(0.0, 2.0, 0.01)
"""Times of the table's rows [s]."""
SHOWN = np.array([0.404, 0.5, 1.111])
"""When the three images were taken [s]."""
SPEED = 0.2
"""Of the yaw [rad/s], which is 0 at time 0."""


@pytest.fixture
def timed(tiny_sequence):
    """Factory of sequences whose yaw tells the time: arguments are lines of `[frames]`, the times of the rows, and an
    edit of the sequence file."""

    def make(frames: str = 'table = "frames.csv"', *, rows=ROWS, shown=SHOWN, edit=str) -> Path:
        def describe(text: str) -> str:
            text = text.replace('frame_id = "{frame:03d}"\n', "")
            return edit(text.replace("[[arms]]", f'[frames]\nframe_id = "{{frame:03d}}"\n{frames}\n[[arms]]', 1))

        path = tiny_sequence(edit=describe)
        for name, sign in (("kinematics.csv", 1), ("truth.csv", -1)):
            with (path.parent / name).open() as handle:
                header, first, *_ = csv.reader(handle)
            yaw, time = header.index("yaw"), header.index("time")
            lines = [list(first) for _ in rows]
            for line, now in zip(lines, rows, strict=True):
                line[yaw], line[time] = repr(float(sign * SPEED * now)), repr(float(now))
            lines = [line[1:] for line in [header, *lines]]  # Rows of such a table are no frames.
            (path.parent / name).write_text("\n".join(",".join(line) for line in lines) + "\n")
        table = ["frame,timestamp", *(f"{row + 1},{now!r}" for row, now in enumerate(shown.tolist()))]
        (path.parent / "frames.csv").write_text("\n".join(table) + "\n")
        return path

    return make


def yaw(sequence: Sequence) -> np.ndarray:
    return sequence.measured["PSM1"][:, sequence.scene.arms[0].robot.joint_names.index("yaw")]


def test_linear_interpolation_gives_the_joint_positions_at_the_time_of_the_image(timed):
    sequence = Sequence.open(timed())
    assert yaw(sequence) == pytest.approx(SPEED * SHOWN, abs=1e-12)
    assert sequence.frame_ids == ("001", "002", "003")
    assert sequence.frame(2).timestamp == SHOWN[2]
    assert sequence.truth is not None
    truth = sequence.truth["PSM1"]
    assert truth[:, sequence.scene.arms[0].robot.joint_names.index("yaw")] == pytest.approx(-SPEED * SHOWN, abs=1e-12)


def test_the_nearest_row_is_taken_as_it_is(timed):
    sequence = Sequence.open(timed('table = "frames.csv"\ninterpolation = "nearest"'))
    assert yaw(sequence) == pytest.approx(SPEED * np.array([0.40, 0.50, 1.11]), abs=1e-12)


def test_a_joint_without_limits_is_interpolated_through_half_a_turn(timed, tmp_path, shipped_psm):
    urdf = write_urdf(tmp_path / "turning.urdf", dict.fromkeys(shipped_psm.joint_names, (-9.0, 9.0)))
    urdf.write_text(urdf.read_text().replace("revolute", "continuous"))
    shown = np.array([0.4, 0.404, 0.408])
    path = timed(rows=shown[[0, 2]], shown=shown, edit=lambda text: text.replace("builtin:psm_lnd", str(urdf)))
    table = path.parent / "kinematics.csv"
    before, after = (repr(float(SPEED * now)) for now in shown[[0, 2]])
    table.write_text(table.read_text().replace(before, "3.13").replace(after, "-3.13"))
    sequence = Sequence.open(path)
    assert np.abs(yaw(sequence)) == pytest.approx([3.13, np.pi, 3.13], abs=1e-9)
    logged = sequence.logged_at(shown).joints["PSM1"][:, sequence.scene.arms[0].robot.joint_names.index("yaw")]
    assert np.abs(logged)[1] == pytest.approx(np.pi, abs=1e-9)


def test_another_offset_can_be_tried_without_touching_the_file(timed):
    path = timed()
    before = path.read_text()
    sequence = Sequence.open(path)
    shifted = sequence.with_time_offset(-0.1)
    assert yaw(shifted) == pytest.approx(SPEED * (SHOWN - 0.1), abs=1e-12)
    assert yaw(sequence) == pytest.approx(SPEED * SHOWN, abs=1e-12)
    assert np.array_equal(shifted.frame(1).images["left"], sequence.frame(1).images["left"])
    assert path.read_text() == before


def test_a_sequence_whose_rows_are_frames_has_no_offset(tiny_sequence):
    with pytest.raises(SequenceError, match=r"does not apply. Give the times of the images under \[frames\]"):
        Sequence.open(tiny_sequence()).with_time_offset(0.1)


def test_times_that_fall_on_rows_and_on_the_ends_take_exactly_these(timed):
    shown = ROWS[[0, 57, -1]]
    for interpolation in ("linear", "nearest"):
        path = timed(f'table = "frames.csv"\ninterpolation = "{interpolation}"\nmax_gap = 0.001', shown=shown)
        assert np.array_equal(yaw(Sequence.open(path)), SPEED * shown)


def test_a_gap_in_the_table_is_refused_with_the_rows_beside_it(timed):
    path = timed(rows=ROWS[(ROWS < 1.0) | (ROWS > 1.3)])
    with pytest.raises(SequenceError) as caught:
        Sequence.open(path)
    message = str(caught.value)
    for part in (
        "kinematics.csv has no joint positions for 1 of 3 frames",
        "frame '003' at 1.111 s of the table's clock",
        "line 101 at 0.99 s and line 102 at 1.31 s",
        "at most 0.1 s are allowed",
        "`time_offset` in [frames]",
        "larger `max_gap`",
    ):
        assert part in message
    path = timed('table = "frames.csv"\nmax_gap = 0.2', rows=ROWS[(ROWS < 1.0) | (ROWS > 1.3)])
    assert yaw(Sequence.open(path)) == pytest.approx(SPEED * SHOWN, abs=1e-12)


def test_clocks_that_do_not_overlap_are_refused_with_both_spans(timed):
    with pytest.raises(SequenceError, match="for 3 of 3 frames") as caught:
        Sequence.open(timed('table = "frames.csv"\ntime_offset = 1.7e9'))
    assert "the rows from 0 to 1.99 s" in str(caught.value)
    sequence = Sequence.open(timed())
    with pytest.raises(SequenceError, match="time_offset = 5 s"):
        sequence.with_time_offset(5.0)


def test_beyond_the_last_row_the_last_row_counts_as_far_as_the_bound(timed):
    shown = np.array([0.0, 1.0, 2.05])
    assert yaw(Sequence.open(timed(shown=shown)))[2] == pytest.approx(SPEED * 1.99)
    with pytest.raises(SequenceError, match=r"frame '003' at 2\.05 s .*next to line 201 at 1\.99 s;"):
        Sequence.open(timed('table = "frames.csv"\nmax_gap = 0.05', shown=shown))


def test_times_that_do_not_increase_are_named_by_line(timed):
    rows = ROWS.copy()
    rows[5] = rows[4]
    with pytest.raises(SequenceError, match=r"kinematics.csv, line 7, column 'time': 0.04 s is not after 0.04 s"):
        Sequence.open(timed(rows=rows))


@pytest.mark.parametrize(
    ("frames", "parts"),
    [
        ("", ["[frames]: table is missing", "`video`"]),
        ('table = "frames.csv"\ntimestamp = ""', ["timestamp is empty", "time of every frame [s]"]),
        ('table = "frames.csv"\ntimestamp = "stamp"', ["no column 'stamp'", "timestamp names"]),
        ('table = "frames.csv"\ntime_ofset = 1.0', ["time_ofset is not a key", "Did you mean 'time_offset'"]),
        ('table = "frames.csv"\ntime_offset = nan', ["time_offset is nan, but must be a finite number"]),
        ('table = "frames.csv"\nmax_gap = 0', ["max_gap is 0.0, but must be a positive number"]),
        ('table = "frames.csv"\ninterpolation = "cubic"', ["interpolation is 'cubic'", "linear, nearest"]),
        ('video = "left.mp4"\ntable = "frames.csv"', ["table cannot be combined with `video`"]),
    ],
)
def test_a_wrong_key_of_the_frames_is_named_with_the_remedy(timed, frames, parts):
    path = timed(frames)
    with pytest.raises(SequenceError) as caught:
        Sequence.open(path)
    for part in [str(path.parent), *parts]:
        assert part in str(caught.value)


def test_with_frames_of_their_own_rows_need_times_and_no_ids(timed):
    with pytest.raises(SequenceError, match=r"\[kinematics\]: timestamp is missing, but with \[frames\]"):
        Sequence.open(timed(edit=lambda text: text.replace('timestamp = "time"\n', "")))
    with pytest.raises(SequenceError, match=r"\[kinematics\]: frame_id describes frames\. Move it to \[frames\]"):
        Sequence.open(timed(edit=lambda text: text.replace("[kinematics]", '[kinematics]\nframe_id = "{frame}"')))


MILLISECONDS = np.array([300, 520, 830, 1900])


def write_brightening(path: Path) -> None:
    """A video whose frame n is as bright as 60 n."""
    images = [np.full((72, 96, 3), 60 * number, np.uint8) for number in range(len(MILLISECONDS))]
    write_video(path, images, milliseconds=MILLISECONDS, options={"bf": "2", "crf": "5"})


def as_video(text: str) -> str:
    lines = [line for line in text.splitlines() if not line.startswith("masks")]
    return "\n".join('images = "left.mp4"' if line.startswith("images") else line for line in lines)


def test_a_video_may_say_which_frames_there_are_and_when(timed):
    path = timed('video = "left.mp4"\ntime_offset = -0.2', edit=as_video)
    write_brightening(path.parent / "left.mp4")
    sequence = Sequence.open(path)
    assert sequence.frame_ids == ("000", "001", "002", "003")
    assert sequence.timestamps == pytest.approx(MILLISECONDS / 1000, abs=1e-6)
    assert yaw(sequence) == pytest.approx(SPEED * (MILLISECONDS / 1000 - 0.2), abs=1e-6)
    for index in (3, 0, 2, 1):
        assert sequence.frame(index).images["left"].mean() == pytest.approx(60 * index, abs=4)


def test_a_table_may_pick_frames_of_a_video(timed):
    path = timed('table = "frames.csv"\nvideo_frame = "number"', edit=as_video)
    write_brightening(path.parent / "left.mp4")
    (path.parent / "frames.csv").write_text("frame,timestamp,number\n1,0.52,1\n2,1.9,3\n")
    sequence = Sequence.open(path)
    assert [round(sequence.frame(index).images["left"].mean() / 60) for index in (0, 1)] == [1, 3]
    assert yaw(sequence) == pytest.approx([SPEED * 0.52, SPEED * 1.9])
