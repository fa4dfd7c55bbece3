"""Results in copies of recorded CSV tables, read back with the csv module."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from corrected_frames import corrected
from lab_robots import write_urdf
from recordings import digests, jaw_at, joints_at, pose_of, write_images

from carts_core.errors import CartsError
from carts_core.export import Dataset, ExportProgress, export
from carts_core.export.source_tables import POSE
from carts_core.model.psm_kinematics import forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import import_recording
from carts_core.settings.interchange import ImportOptions

FRAMES, RATE = 6, 25.0
NAMES = ["yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw"]
START = 1_700_000_000_000_000_000


def values_at(time: float) -> list[float]:
    return [*joints_at(time), float(jaw_at(time))]


def imported(path: Path, folder: Path, options: ImportOptions | None = None) -> Dataset:
    sequence = Sequence.open(import_recording(path, folder, options)[0])
    return Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")


def rows_of(path: Path, skipped: int = 0, delimiter: str = ",") -> list[dict[str, str]]:
    lines = path.read_text().splitlines()[skipped:]
    return list(csv.DictReader(lines, delimiter=delimiter))


def with_rows_per_image(path: Path) -> Path:
    """Degrees and millimetres, semicolons, and a row of units."""
    write_images(path / "left", FRAMES)
    scale = np.array([180 / np.pi] * 7)
    scale[2] = 1e3
    lines = ["image;" + ";".join(NAMES), ";deg;deg;mm;deg;deg;deg;deg"]
    for number in range(FRAMES):
        cells = (np.array(values_at(number / RATE)) * scale).tolist()
        lines.append(f"{number:04d}.png;" + ";".join(map(repr, cells)))
    (path / "kinematics.csv").write_text("\n".join(lines) + "\n")
    return path


def test_a_row_per_image_gets_the_values_of_its_frame_in_the_units_of_the_table(tmp_path):
    path = with_rows_per_image(tmp_path / "set")
    before = digests(path)
    data = imported(path, tmp_path / "sequence")
    out = export(data, "recorded-csv", tmp_path / "out")
    assert digests(path) == before
    units, *rows = rows_of(out / "kinematics.csv", delimiter=";")
    old = rows_of(path / "kinematics.csv", delimiter=";")[1:]
    assert units["yaw"] == "deg" and units["yaw.corrected"] == "" and len(rows) == FRAMES
    for frame, row, recorded in zip(data.frames, rows, old, strict=True):
        assert {key: row[key] for key in recorded} == recorded
        changed = frame.source != "measured"
        assert row["PSM1.corrected"] == str(int(changed)) and row["PSM1.verdict"] == (frame.verdict or "")
        found = np.array([float(row[f"{name}.corrected"]) for name in NAMES])
        if not changed:
            np.testing.assert_array_equal(found, [float(recorded[name]) for name in NAMES])
            assert row["yaw.std"] == "nan"
            continue
        found[[0, 1, 3, 4, 5, 6]] = np.radians(found[[0, 1, 3, 4, 5, 6]])
        found[2] *= 1e-3
        np.testing.assert_allclose(found, frame.joint_positions["PSM1"], rtol=0, atol=1e-9)
        assert float(row["insertion.std"]) == pytest.approx(1e3 * (frame.joint_std or {})["PSM1"][2])
    for view in data.views(ExportProgress()):
        mask = cv2.imread(str(out / f"carts_mask/left/{view.frame.frame_id}.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None and ((mask > 127) == (view.link_ids >= 0)).all()


def test_a_row_per_image_with_a_time_offset_gets_the_values_of_its_frame(tmp_path):
    path = with_rows_per_image(tmp_path / "set")
    data = imported(path, tmp_path / "sequence", ImportOptions(frame_rate=RATE, time_offset=1 / RATE))
    data = replace(data, frames=data.frames[:-1])
    _, *rows = rows_of(export(data, "recorded-csv", tmp_path / "out") / "kinematics.csv", delimiter=";")
    expected = [*(frame.joint_positions["PSM1"] for frame in data.frames), data.sequence.measured["PSM1"][-1]]
    found = np.radians([float(row["yaw.corrected"]) for row in rows])
    np.testing.assert_allclose(found, np.array(expected)[:, 0], rtol=0, atol=1e-9)
    assert [row["PSM1.corrected"] for row in rows] == ["1", "0", "1", "1", "1", "0"]


def with_two_arms(path: Path) -> Path:
    """A table separated by blanks."""
    write_images(path / "left", FRAMES)
    names = [f"{arm}_{name}" for arm in ("psm1", "psm2") for name in NAMES]
    rows = [values_at(number / RATE) + values_at(1 + number / RATE) for number in range(FRAMES)]
    np.savetxt(path / "joints.txt", rows, header=" ".join(names))
    return path


@pytest.mark.parametrize("names", [("PSM1", "PSM2"), ("LEFT", "RIGHT")])
def test_two_arms_are_recognized_by_their_values_and_blanks_separate_all_columns(tmp_path, names):
    options = ImportOptions(arms=dict(zip(names, ("PSM1", "PSM2"), strict=True)))
    data = imported(with_two_arms(tmp_path / "set"), tmp_path / "sequence", options)
    header, *lines = (export(data, "recorded-csv", tmp_path / "out") / "joints.txt").read_text().splitlines()
    columns = header.removeprefix("# ").split()
    for frame, line in zip(data.frames, lines, strict=True):
        row = dict(zip(columns, line.split(), strict=True))
        for recorded, name in zip(("psm1", "psm2"), names, strict=True):
            assert row[f"{name}.verdict"] == (frame.verdict or "-")
            found = [float(row[f"{recorded}_{joint}.corrected"]) for joint in NAMES]
            np.testing.assert_allclose(found, frame.joint_positions[name], rtol=0, atol=1e-9)


def test_columns_that_were_chosen_are_recognized_by_their_values(tmp_path):
    path = tmp_path / "set"
    write_images(path / "left", FRAMES)
    names = [f"m{letter}" for letter in "abcdefg"]
    lines = [",".join(["note", *names])]
    lines += [",".join(["x", *map(str, values_at(number / RATE))]) for number in range(FRAMES)]
    (path / "motors.csv").write_text("\n".join(lines) + "\n")
    options = ImportOptions(columns=dict(zip(NAMES, names, strict=True)))
    data = imported(path, tmp_path / "sequence", options)
    for frame, row in zip(
        data.frames, rows_of(export(data, "recorded-csv", tmp_path / "out") / "motors.csv"), strict=True
    ):
        found = [float(row[f"{name}.corrected"]) for name in names]
        np.testing.assert_allclose(found, frame.joint_positions["PSM1"], rtol=0, atol=1e-9)


def test_an_empty_cell_of_a_pose_beside_joints_leaves_out_no_row(tmp_path):
    path = tmp_path / "set"
    write_images(path / "left", FRAMES)
    lines = [",".join(["frame", *NAMES, *POSE])]
    for number in range(FRAMES):
        pose = map(repr, map(float, pose_of(forward(joints_at(number / RATE)))))
        cells = ["" if (number, part) == (2, "y") else cell for part, cell in zip(POSE, pose, strict=True)]
        lines.append(",".join([str(number), *map(str, values_at(number / RATE)), *cells]))
    (path / "psm1.csv").write_text("\n".join(lines) + "\n")
    data = imported(path, tmp_path / "sequence")
    row = rows_of(export(data, "recorded-csv", tmp_path / "out") / "psm1.csv")[2]
    found = [float(row[f"{name}.corrected"]) for name in ("yaw", "y")]
    joints = data.frames[2].joint_positions["PSM1"]
    np.testing.assert_allclose(found, [joints[0], forward(joints[:6])[1, 3]], rtol=0, atol=1e-9)


def with_a_log(path: Path) -> Path:
    """As dvrk_data extracts topics: comment lines, nanoseconds, 100 rows a second."""
    write_images(path / "left", FRAMES)
    lines = ["# Topic: /PSM1/measured_js", "# Type: sensor_msgs/msg/JointState"]
    lines.append("timestamp," + ",".join(f"position.{number}" for number in range(6)))
    for row in range(30):
        lines.append(f"{START + row * 10_000_000}," + ",".join(map(repr, joints_at(row / 100).tolist())))
    (path / "_PSM1_measured_js.csv").write_text("\n".join(lines) + "\n")
    return path


def test_a_log_with_times_gets_interpolated_corrections_between_consecutive_frames(tmp_path):
    path = with_a_log(tmp_path / "set")
    data = imported(path, tmp_path / "sequence", ImportOptions(frame_rate=RATE))
    out = export(data, "recorded-csv", tmp_path / "out")
    text, old = ((folder / "_PSM1_measured_js.csv").read_text().splitlines() for folder in (out, path))
    assert text[:2] == old[:2] and all(new.startswith(line) for new, line in zip(text, old, strict=True))
    rows = rows_of(out / "_PSM1_measured_js.csv", 2)
    found = np.array([[float(row[f"position.{number}.corrected"]) for number in range(6)] for row in rows])
    marks = np.array([row["PSM1.corrected"] == "1" for row in rows])
    # Frame n is at row 4 n; frame 1 is not corrected, so neither are the rows between frames 0 and 2.
    assert np.flatnonzero(marks).tolist() == [0, *range(8, 21)]
    for frame in data.frames:
        if frame.source != "measured":
            # Doubles resolve times since 1970 to 0.2 µs, in which a joint moves up to 5e-7 rad.
            np.testing.assert_allclose(found[4 * frame.index], frame.joint_positions["PSM1"][:6], rtol=0, atol=5e-7)
    recorded = np.array([joints_at(row / 100) for row in range(30)])
    change = found - recorded
    np.testing.assert_allclose(change[14], (change[12] + change[16]) / 2, rtol=0, atol=5e-8)
    np.testing.assert_array_equal(found[~marks], recorded[~marks])


@pytest.mark.parametrize(("offset", "row", "frame"), [(-0.02, 0, 0), (0.12, 29, 5)])
def test_a_frame_shortly_outside_of_the_log_corrects_its_first_or_last_row(tmp_path, offset, row, frame):
    path = with_a_log(tmp_path / "set")
    data = imported(path, tmp_path / "sequence", ImportOptions(frame_rate=RATE, time_offset=1e-9 * START + offset))
    rows = rows_of(export(data, "recorded-csv", tmp_path / "out") / "_PSM1_measured_js.csv", 2)
    found = [float(rows[row][f"position.{number}.corrected"]) for number in range(6)]
    np.testing.assert_allclose(found, data.frames[frame].joint_positions["PSM1"][:6], rtol=0, atol=1e-9)


def test_a_continuous_joint_is_corrected_where_it_wraps(tmp_path, shipped_psm):
    path, half_row = with_a_log(tmp_path / "set"), 0.005
    log = path / "_PSM1_measured_js.csv"
    lines = log.read_text().splitlines()
    for row in range(30):
        cells = lines[3 + row].split(",")
        cells[4] = repr(float((row - 8.5) * 1e-3 + (np.pi if row <= 8 else -np.pi)))  # wraps at frame 2
        lines[3 + row] = ",".join(cells)
    log.write_text("\n".join(lines) + "\n")
    data = imported(path, tmp_path / "sequence", ImportOptions(frame_rate=RATE, time_offset=1e-9 * START + half_row))
    urdf = write_urdf(tmp_path / "turning.urdf", dict.fromkeys(shipped_psm.joint_names, (-9.0, 9.0)))
    urdf.write_text(urdf.read_text().replace("revolute", "continuous"))
    text = data.sequence.path.read_text()
    data.sequence.path.write_text(text.replace("builtin:psm_lnd", str(urdf)))
    sequence = Sequence.open(data.sequence.path)
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")
    rows = rows_of(export(data, "recorded-csv", tmp_path / "out") / log.name, 2)
    change = [float(row["position.3.corrected"]) - float(row["position.3"]) for row in rows]
    # Frame 2 is corrected by 3e-3 cos(3), frame 3 by 4e-3 cos(3); rows between them are interpolated.
    np.testing.assert_allclose(change[9:12], 1e-3 * np.cos(3) * (3 + np.array([1, 3, 5]) / 8), rtol=0, atol=2e-6)


def test_tip_poses_are_corrected_in_their_own_frame(tmp_path):
    path = tmp_path / "set"
    write_images(path / "left", FRAMES)
    lines = ["frame,x,y,z,qx,qy,qz,qw"]
    for number in range(FRAMES):
        lines.append(f"{number}," + ",".join(map(repr, map(float, pose_of(forward(joints_at(number / RATE)))))))
    (path / "psm1.csv").write_text("\n".join(lines) + "\n")
    data = imported(path, tmp_path / "sequence")
    rows = rows_of(export(data, "recorded-csv", tmp_path / "out") / "psm1.csv")
    for frame, row in zip(data.frames, rows, strict=True):
        if frame.source != "measured":
            expected = forward(frame.joint_positions["PSM1"][:6])[:3, 3]
            found = [float(row[f"{axis}.corrected"]) for axis in "xyz"]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_a_table_of_another_recording_is_refused(tmp_path):
    data = imported(with_rows_per_image(tmp_path / "set"), tmp_path / "sequence")
    other = with_a_log(tmp_path / "other")
    with pytest.raises(CartsError, match=r"no CSV table of .*_PSM1_measured_js\.csv.*--recording FILE\.csv"):
        export(replace(data, recording=other), "recorded-csv", tmp_path / "out")
    table = tmp_path / "set/kinematics.csv"
    first = export(data, "recorded-csv", tmp_path / "first") / "kinematics.csv"
    with pytest.raises(CartsError, match="is an export itself"):
        export(replace(data, recording=first), "recorded-csv", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert export(replace(data, recording=table), "recorded-csv", tmp_path / "out").is_dir()
