"""A delay between images and kinematics, found in a video of a synthetic motion."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from swaying import LOGS, swaying_joints, write_log, write_swaying

from carts_core.cli.command_line import main
from carts_core.errors import SequenceError
from carts_core.model.robot import Robot
from carts_core.recording import Sequence, estimate_time_offsets
from carts_core.recording.time_delay import TimeOffsetEstimate
from carts_core.resources import shipped_robot

SEED, SECONDS = 3, 5.0
DELAY = 0.12


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_swaying(tmp_path_factory.mktemp("swaying"), Robot.load(shipped_robot()), SEED, SECONDS)


@pytest.fixture
def recording(recorded: Path, tmp_path: Path) -> Path:
    """The recording in a folder of the test's own."""
    shutil.copytree(recorded.parent, tmp_path / "own")
    return tmp_path / "own" / "sequence.toml"


@pytest.fixture
def late(recording: Path, shipped_psm: Robot) -> Path:
    """With a log whose stamps are late by 120 ms."""
    write_log(recording.with_name("log.csv"), shipped_psm, SEED, SECONDS, DELAY)
    return recording


def test_a_delay_of_120_ms_is_found_to_10_ms_and_proposed(late: Path) -> None:
    done: list[tuple[int, int]] = []
    (found,) = estimate_time_offsets(Sequence.open(late), progress=lambda *now: done.append(now))
    assert abs(found.seconds - DELAY) < 0.010 and found.deviation < 0.010
    assert found.proposed == round(found.seconds, 4)
    assert found.explained > found.explained_now + 0.1
    assert "Proposed: time_offset" in found.sentence() and done[-1] == (150, 150)


def test_kinematics_of_another_motion_give_no_delay(recording: Path, shipped_psm: Robot) -> None:
    write_log(recording.with_name("log.csv"), shipped_psm, SEED + 1, SECONDS)
    (found,) = estimate_time_offsets(Sequence.open(recording))
    assert found.proposed is None and found.problem is not None
    assert "is unknown" in found.sentence()


def test_a_delay_of_2_4_s_is_found(recording: Path, shipped_psm: Robot) -> None:
    late = 71 / 30
    write_log(recording.with_name("log.csv"), shipped_psm, SEED, SECONDS + 2.0, late)
    (found,) = estimate_time_offsets(Sequence.open(recording))
    assert found.proposed is not None and abs(found.proposed - late) < 0.010


def test_several_delays_that_explain_as_much_are_said(recording: Path) -> None:
    """A motion that repeats itself every 0.4 s, in images and log."""
    log = recording.with_name("log.csv")
    header, *rows = log.read_text().splitlines()
    cells = [row.split(",", 1) for row in rows]
    period = [rest for stamp, rest in cells if 0.0 <= float(stamp) < 0.4 - 1e-6]
    log.write_text("\n".join([header, *(f"{stamp},{period[row % 40]}" for row, (stamp, _) in enumerate(cells))]) + "\n")
    video = recording.with_name("times.csv")
    video.write_text("frame,timestamp,number\n" + "".join(f"{n},{n / 30:.5f},{n % 12}\n" for n in range(140)))
    text = recording.read_text().replace('[frames]\nvideo = "left.mp4"', '[frames]\ntable = "times.csv"')
    recording.write_text(text.replace('images = "left.mp4"', 'images = "left.mp4"\nvideo_frame = "number"'))
    (found,) = estimate_time_offsets(Sequence.open(recording))
    assert found.proposed is None and len(found.others) >= 1
    assert min(abs(found.others[0] - found.seconds - k * 0.4) for k in range(-12, 13) if k) < 0.07
    assert "several delays are equally good" in found.sentence()


def test_an_arm_that_stands_still_gives_no_delay(recording: Path) -> None:
    log = recording.with_name("log.csv")
    header, first, *rest = log.read_text().splitlines()
    still = [f"{row.split(',')[0]},{first.split(',', 1)[1]}" for row in [first, *rest]]
    log.write_text("\n".join([header, *still]) + "\n")
    assert estimate_time_offsets(Sequence.open(recording))[0].problem == "no joint moves in the table."


def test_few_frames_give_no_delay(recording: Path) -> None:
    (recording.parent / "times.csv").write_text("frame,timestamp\n" + "".join(f"{n},{n / 30:.4f}\n" for n in range(20)))
    recording.write_text(recording.read_text().replace('[frames]\nvideo = "left.mp4"', '[frames]\ntable = "times.csv"'))
    (found,) = estimate_time_offsets(Sequence.open(recording))
    assert found.problem == "there are 19 steps between frames; at least 60 are needed."


def test_missing_images_give_no_flow(late: Path) -> None:
    video = Sequence.open(late)
    times = late.with_name("times.csv")
    assert video.timestamps is not None
    times.write_text("frame,timestamp\n" + "".join(f"{n},{time:.5f}\n" for n, time in enumerate(video.timestamps)))
    late.with_name("left").mkdir()
    for index in set(range(len(video))) - set(range(5, len(video), 6)):
        cv2.imwrite(str(late.parent / f"left/{index}.png"), video.frame(index).images["left"][..., ::-1])
    text = late.read_text().replace('[frames]\nvideo = "left.mp4"', '[frames]\ntable = "times.csv"')
    late.write_text(text.replace('images = "left.mp4"', 'images = "left/{frame}.png"\nsparse_images = true'))
    (found,) = estimate_time_offsets(Sequence.open(late))
    assert abs(found.seconds - DELAY) < 0.010 and found.explained > 0.8


def test_a_small_difference_is_not_worth_a_change() -> None:
    near = TimeOffsetEstimate(0.0, 0.007, 0.001, 0.9, 0.9, None)
    uncertain = TimeOffsetEstimate(0.0, 0.02, 0.01, 0.9, 0.9, None)
    assert near.proposed is None and uncertain.proposed is None


def test_the_command_proposes_and_writes(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = late.read_text()
    main(["time-offset", str(late), "-o", str(tmp_path / "shifted")])
    assert "Proposed: time_offset" in capsys.readouterr().out
    assert late.read_text() == before
    shifted = Sequence.open(tmp_path / "shifted" / "sequence.toml")
    assert shifted.matching is not None and abs(shifted.matching.time_offset - DELAY) < 0.010
    main(["time-offset", str(tmp_path / "shifted" / "sequence.toml"), "-o", str(tmp_path / "again")])
    assert "agrees with the motion" in capsys.readouterr().out and not (tmp_path / "again").exists()
    assert np.isfinite(shifted.measured["PSM1"]).all()


def test_frames_without_rows_at_the_proposed_offset_are_left_out(
    late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A log that ends with the video: the last images would have rows 120 ms later."""
    log = late.with_name("log.csv")
    header, *rows = log.read_text().splitlines()
    log.write_text("\n".join([header, *(row for row in rows if float(row.split(",")[0]) < SECONDS - 0.03)]) + "\n")
    whole = Sequence.open(late)
    main(["time-offset", str(late), "-o", str(tmp_path / "shifted"), "--largest", "1"])
    shifted = Sequence.open(tmp_path / "shifted" / "sequence.toml")
    assert shifted.matching is not None and abs(shifted.matching.time_offset - DELAY) < 0.010
    missing = len(whole) - len(shifted)
    assert 0 < missing < 5 and f"{missing} of 150 frames have no rows" in capsys.readouterr().out
    assert any(f"{missing} of 150 frames are left out" in remark for remark in shifted.remarks)
    assert shifted.frame_ids == whole.frame_ids[:-missing]
    last = len(shifted) - 1
    np.testing.assert_array_equal(shifted.frame(last).images["left"], whole.frame(last).images["left"])
    with pytest.raises(SequenceError, match=r'missing_rows = "omit"'):
        Sequence.open(_without_key(tmp_path / "shifted" / "sequence.toml", "missing_rows"))


def _without_key(path: Path, key: str) -> Path:
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith(key)))
    return path


def test_an_import_estimates_the_delay(late: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    late.unlink()
    main(["import", str(late.parent), "-o", str(tmp_path / "new"), "--columns", "time", "stamp"])
    assert "time offset 0.1" in (said := capsys.readouterr().out) and "estimated from the motion" in said
    sequence = Sequence.open(tmp_path / "new" / "sequence.toml")
    assert sequence.matching is not None and abs(sequence.matching.time_offset - DELAY) < 0.010
    main(
        ["import", str(late.parent), "-o", str(tmp_path / "given"), "--columns", "time", "stamp", "--time-offset", "0"]
    )
    assert "estimated from the motion" not in capsys.readouterr().out


def test_an_import_of_rows_without_times_estimates_the_delay(
    recording: Path, shipped_psm: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images as files, and one row for each: joints of 21 images earlier, at an assumed rate of 30 images/s."""
    folder = tmp_path / "rows"
    (folder / "left").mkdir(parents=True)
    video = Sequence.open(recording)
    joints = swaying_joints(shipped_psm, np.arange(len(video)) / 30 - 0.7, SEED)
    lines = [",".join(shipped_psm.joint_names), *(",".join(map(str, row)) for row in joints)]
    (folder / "joints.csv").write_text("\n".join(lines) + "\n")
    for index in range(len(video)):
        cv2.imwrite(str(folder / "left" / f"{index:04d}.png"), video.frame(index).images["left"][..., ::-1])
    main(["import", str(folder), "-o", str(tmp_path / "new")])
    assert "30 images/s are assumed" in capsys.readouterr().out
    sequence = Sequence.open(tmp_path / "new" / "sequence.toml")
    assert sequence.matching is not None and abs(sequence.matching.time_offset - 0.7) < 0.010


PERIODS = {"neither": (None, None), "both": (1.7, 1.1), "equal": (2.0, 2.0), "one": (None, 1.3)}
PAIRS, LENGTH = 10, 8.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("periodic", PERIODS)
def test_delays_of_two_arms_are_found_or_named(periodic: str, tmp_path: Path, shipped_psm: Robot) -> None:
    """Delays of -2.4 to 2.4 s, equal in each third recording: found to 10 ms, or among at most 20 named ones."""
    seed, periods = 3 + len(periodic), PERIODS[periodic]
    path = write_swaying(tmp_path, shipped_psm, seed, LENGTH, periods=periods)
    rng, found = np.random.default_rng(seed), 0
    for number in range(PAIRS):
        delays = rng.uniform(-2.4, 2.4, 2)
        if number % 3 == 2:
            delays[1] = delays[0]
        for n in (0, 1):
            write_log(path.with_name(LOGS[n]), shipped_psm, seed + 100 * n, LENGTH, delays[n], periods[n])
        estimates = {each.arm: each for each in estimate_time_offsets(Sequence.open(path))}
        for arm, delay in zip(("PSM1", "PSM2"), delays, strict=True):
            each = estimates.get(arm) or estimates[""]
            named = (each.seconds, *each.others, *each.alone.get(arm, ()))
            assert min(abs(offset - delay) for offset in named) < 0.010 and len(named) <= 20, (arm, delays, each)
            assert all(f"{offset:.3f} s" in each.sentence() for offset in named)
            for listed in ((each.seconds, *each.others), each.alone.get(arm, ())):
                assert np.diff(np.sort(listed)).min(initial=1.0) > 0.1
            found += each.problem is None
    assert found >= (PAIRS if periods[0] is None else 0)
