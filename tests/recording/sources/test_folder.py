"""Generic recordings of images, tables and calibrations: correct guesses that are shown and can be changed."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from recordings import SIZE, START, K, copied, image, joints_at, pose_of, ros_yaml, write, write_images
from scipy.io import savemat
from videos import write_video

from carts_core.cli import main
from carts_core.errors import CartsError, OutputError
from carts_core.model.psm_kinematics import JOINT_NAMES, forward
from carts_core.project import Project
from carts_core.recording import Sequence
from carts_core.recording.importing.foreign_tables import read_foreign_table
from carts_core.recording.importing.importer import find, import_recording
from carts_core.recording.importing.writing import write_sequence
from carts_core.settings.interchange import ImportOptions

FRAMES = 5


def write_csv(path: Path, header: list[str], rows: np.ndarray, delimiter: str = ",") -> None:
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream, delimiter=delimiter)
        writer.writerows([header, *rows.tolist()])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of `lab`, under an awkward name."""
    return copied(lab, tmp_path / "Recording {1}")


def lab(source: Path) -> Path:
    """Two cameras, joints in degrees and millimetres with custom names, and a ROS calibration."""
    write_images(source / "imgs_left", FRAMES, "img_{:04d}.png")
    write_images(source / "imgs_right", FRAMES, "img_{:04d}.png", "right")
    q = joints_at(np.arange(FRAMES) / 10)
    scaled = q * np.where(np.arange(6) == 2, 1e3, 180 / np.pi)
    write_csv(
        source / "log.csv",
        ["image", *(f"Joint{n} [deg]" for n in range(1, 7))],
        np.column_stack([range(FRAMES), scaled]),
    )
    for side, shift in (("left", 0.0), ("right", -0.55)):
        P = np.column_stack([K, [shift, 0, 0]])
        (source / f"{side}.yaml").write_text(ros_yaml(np.eye(3), P, name=side))
    return source


def test_two_folders_a_table_in_degrees_and_ros_calibrations_need_no_word(folder, tmp_path, capsys):
    main(["import", str(folder), "-o", str(tmp_path / "out")])
    sequence = Sequence.open(tmp_path / "out/sequence.toml")
    for index in range(FRAMES):
        frame = sequence.frame(index)
        assert np.abs(frame.measured["PSM1"][:6] - joints_at(index / 10)).max() < 1e-7
    left, right = sequence.scene.cameras
    assert left.intrinsics == pytest.approx((110, 110, 48, 36)) and left.distortion[:2] == (-0.1, 0.02)
    assert right.T_camera_world[0, 3] == pytest.approx(-0.005)
    said = " ".join(capsys.readouterr().out.split())
    assert "guessed: PSM1: angles are in deg, lengths in mm (change: --angle-unit, --length-unit)" in said
    assert "guessed: left: the calibration is left.yaml" in said
    assert "missing: PSM1: no base frame (hand-eye calibration)" in said


def test_every_guess_can_be_changed(folder):
    found = find(folder, ImportOptions(angle_unit="rad", length_unit="m", calibration={"left": folder / "right.yaml"}))
    assert found.arms[0].values is not None and np.abs(found.arms[0].values).max() > 10
    columns = {name: f"Joint{number} [deg]" for number, name in zip((2, 1, 3, 4, 5, 6), JOINT_NAMES, strict=True)}
    swapped = find(folder, ImportOptions(columns=columns, arms={"PSM7": ""}))
    assert swapped.arms[0].name == "PSM7" and swapped.arms[0].values is not None
    assert swapped.arms[0].values[3, 1] == pytest.approx(joints_at(0.3)[0])
    images = {"scope": "imgs_right"}
    assert [camera.name for camera in find(folder, ImportOptions(images=images)).cameras] == ["scope"]


@pytest.mark.parametrize("header", [["x", "y", "z"], ["px", "py", "pz", "rx"]])
def test_a_table_that_is_no_pose_is_named_with_its_columns(tmp_path, header):
    write_images(tmp_path / "rec/left", FRAMES)
    write_csv(tmp_path / "rec/poses.csv", header, np.ones((FRAMES, len(header))))
    (note,) = [str(note) for note in find(tmp_path / "rec").notes if "no table" in str(note)]
    assert f"poses.csv has {', '.join(header)}" in note and "tip pose (x, y, z, qx, qy, qz, qw)" in note
    left_out = find(tmp_path / "rec", ImportOptions(kinematics=Path("none")))
    assert not [note for note in left_out.notes if "no table" in str(note)]


def test_a_log_with_times_is_matched_with_a_table_of_image_times(tmp_path):
    write_images(tmp_path / "rec/left", FRAMES)
    stamps = START + np.arange(-3, 60) * 10_000_000
    rows = np.column_stack([stamps.astype(str), joints_at((stamps - START) * 1e-9).astype(str)])
    write_csv(tmp_path / "rec/psm.csv", ["stamp", *(f"PSM2_q{n}" for n in range(6))], rows)
    frame_times = START + np.arange(FRAMES) * 100_000_000
    write_csv(tmp_path / "rec/frames.csv", ["frame", "timestamp_ns"], np.column_stack([np.arange(FRAMES), frame_times]))
    file, found = import_recording(tmp_path / "rec", tmp_path / "out")
    assert any("are in ns (change: --clock)" in str(note) for note in found.notes)
    sequence = Sequence.open(file)
    assert np.abs(sequence.frame(3).measured["PSM2"][:6] - joints_at(0.3)).max() < 1e-5


def test_a_project_in_the_folder_is_not_deleted_by_overwrite(folder: Path, tmp_path: Path) -> None:
    file, _ = import_recording(folder, tmp_path / "out")
    Project.open(Sequence.open(file)).close()
    (tmp_path / "out/sequence_exports").mkdir()
    project = (tmp_path / "out/sequence.carts").read_bytes()
    with pytest.raises(OutputError, match=r"contains sequence\.carts, sequence_exports.* Move them out of this folder"):
        import_recording(folder, tmp_path / "out", overwrite=True)
    assert (tmp_path / "out/sequence.carts").read_bytes() == project
    (tmp_path / "out/sequence.carts").rename(tmp_path / "kept.carts")
    (tmp_path / "out/sequence_exports").rmdir()
    import_recording(folder, tmp_path / "out", overwrite=True)


def test_a_video_with_another_clock_gets_a_guessed_offset_that_is_said(tmp_path):
    (tmp_path / "rec").mkdir()
    write_video(tmp_path / "rec/scope.mp4", [image(number) for number in range(20)])
    times = np.arange(200) / 100
    poses = np.array([pose_of(T) for T in forward(joints_at(times))])
    header = ["time", *(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw")]
    columns = {name: np.column_stack([1000 + times, poses])[:, index] for index, name in enumerate(header)}
    pyarrow.parquet.write_table(pyarrow.table(columns), tmp_path / "rec/poses.parquet")
    file, found = import_recording(tmp_path / "rec", tmp_path / "out")
    assert found.time_offset == pytest.approx(1000.0)
    assert any(note.kind == "guessed" and "clocks do not overlap" in str(note) for note in found.notes)
    assert np.abs(Sequence.open(file).frame(10).measured["PSM1"][:6] - joints_at(0.4)).max() < 1e-4


def two_arms(folder: Path, header: str) -> None:
    write_images(folder / "left", FRAMES)
    times = np.arange(FRAMES) / 10
    for arm in (1, 2):
        names = ["timestamp", *(header.format(arm=arm, joint=joint) for joint in range(1, 7))]
        write_csv(folder / f"psm{arm}.csv", names, np.column_stack([times, joints_at(times + arm)]))
    write_csv(folder / "frames.csv", ["frame", "timestamp"], np.column_stack([np.arange(FRAMES), times]))


def test_a_chosen_column_leaves_the_other_arms(tmp_path):
    two_arms(tmp_path / "rec", "q{joint}")
    for columns in ({}, {"time": "timestamp"}, {"yaw": "q1"}):
        found = find(tmp_path / "rec", ImportOptions(columns=columns))
        assert [arm.name for arm in found.arms] == ["PSM1", "PSM2"], columns


def test_an_unreadable_table_beside_others_is_a_warning(tmp_path):
    two_arms(tmp_path / "rec", "q{joint}")
    with (tmp_path / "rec/psm2.csv").open("a") as stream:
        stream.write("1.0,2.0\n")
    found = find(tmp_path / "rec")
    assert [arm.name for arm in found.arms] == ["PSM1"]
    assert any("psm2.csv cannot be read, and is not used" in str(note) for note in found.notes)


def test_names_of_arms_and_joints_may_be_one_word(tmp_path):
    write_images(tmp_path / "rec/left", FRAMES)
    q = [joints_at(np.arange(FRAMES) / 10 + arm) for arm in (1, 2)]
    header = ["frame", *(f"PSM{arm}Joint{joint}" for arm in (1, 2) for joint in range(1, 7))]
    write_csv(tmp_path / "rec/joints.csv", header, np.column_stack([np.arange(FRAMES), *q]))
    arms = find(tmp_path / "rec").arms
    assert [arm.name for arm in arms] == ["PSM1", "PSM2"]
    for arm, expected in zip(arms, q, strict=True):
        assert arm.values is not None and np.allclose(arm.values[:, :6], expected)


def test_a_calibration_beside_a_video_is_no_sidecar_of_a_dvrk_session(tmp_path):
    (tmp_path / "rec").mkdir()
    write_video(tmp_path / "rec/left.mp4", [image(number) for number in range(FRAMES)])
    (tmp_path / "rec/left.json").write_text(json.dumps({"K": K.tolist(), "D": [0, 0, 0, 0]}))
    write_csv(tmp_path / "rec/log.csv", [f"q{n}" for n in range(6)], joints_at(np.arange(FRAMES) / 25))
    found = find(tmp_path / "rec")
    assert found.arms and found.cameras[0].intrinsics == (110, 110, 47.5, 35.5)


def test_a_table_of_a_thousand_episodes_is_read_and_a_larger_one_is_refused_with_the_limit(tmp_path):
    values = np.random.default_rng(0).normal(size=(400_000, 14)).astype(np.float32)
    listed = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(values.reshape(-1)), 14)
    pyarrow.parquet.write_table(pyarrow.table({"state": listed, "action": listed}), tmp_path / "file.parquet")
    columns = read_foreign_table(tmp_path / "file.parquet").columns
    assert np.array_equal(columns["action.13"], values[:, 13]) and len(columns) == 28
    pyarrow.parquet.write_table(pyarrow.table({"q": np.zeros(1_500_001, np.int8)}), tmp_path / "long.parquet")
    with pytest.raises(
        CartsError, match=r"long\.parquet has 1,500,001 rows; at most 1,500,000 are read\. Split it"
    ) as refusal:
        read_foreign_table(tmp_path / "long.parquet")
    assert "again" not in str(refusal.value)


def test_a_video_in_a_folder_with_braces_is_found(tmp_path):
    (tmp_path / "run{1}").mkdir()
    write_video(tmp_path / "run{1}/left.mp4", [image(number) for number in range(FRAMES)])
    write_csv(tmp_path / "run{1}/log.csv", [f"q{n}" for n in range(6)], joints_at(np.arange(FRAMES) / 25))
    assert len(Sequence.open(import_recording(tmp_path / "run{1}", tmp_path / "out")[0])) == FRAMES


def test_arrays_of_different_lengths_are_named(tmp_path):
    write_images(tmp_path / "rec/left", FRAMES)
    np.savez(tmp_path / "rec/log.npz", time=np.arange(3), joints=joints_at(np.arange(FRAMES) / 10))
    with pytest.raises(CartsError, match=r"different numbers of rows \(time 3, joints_1 5"):
        find(tmp_path / "rec", ImportOptions(kinematics=Path("log.npz")))


def test_numpy_arrays_of_joint_states_are_read(tmp_path):
    write_images(tmp_path / "rec/images", FRAMES)
    q = joints_at(np.arange(FRAMES) / 10)
    np.save(tmp_path / "rec/psm1_js.npy", np.stack([q, 0 * q, 0 * q], 1))
    file, _ = import_recording(tmp_path / "rec", tmp_path / "out")
    assert np.abs(Sequence.open(file).frame(4).measured["PSM1"][:6] - joints_at(0.4)).max() < 1e-7


def opencv_yaml(path: Path) -> None:
    numbers = ", ".join(map(str, K.reshape(-1)))
    matrix = "!!opencv-matrix\n   rows: {}\n   cols: {}\n   dt: d\n   data: [{}]\n"
    path.write_text(
        f"%YAML:1.0\n---\nM1: {matrix.format(3, 3, numbers)}D1: {matrix.format(1, 5, '-0.1, 0.02, 0, 0, 0')}"
        f"M2: {matrix.format(3, 3, numbers)}D2: {matrix.format(1, 5, '0, 0, 0, 0, 0')}"
        f"R: {matrix.format(3, 3, '1, 0, 0, 0, 1, 0, 0, 0, 1')}T: {matrix.format(3, 1, '-5.0, 0, 0')}"
    )


def kalibr_yaml(path: Path) -> None:
    path.write_text(
        "cam0:\n  distortion_model: radtan\n  intrinsics: [110, 110, 47.5, 35.5]\n"
        f"  distortion_coeffs: [-0.1, 0.02, 0, 0]\n  resolution: [{SIZE[0]}, {SIZE[1]}]\n"
        "cam1:\n  T_cn_cnm1: [[1, 0, 0, -0.005], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
        "  distortion_model: radtan\n"
        f"  intrinsics: [110, 110, 47.5, 35.5]\n  distortion_coeffs: [0, 0, 0, 0]\n"
        f"  resolution: [{SIZE[0]}, {SIZE[1]}]\n"
    )


def matlab(path: Path) -> None:
    one = K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    first = {"IntrinsicMatrix": one.T, "RadialDistortion": [-0.1, 0.02], "TangentialDistortion": [0.0, 0.0]}
    second = {**first, "RadialDistortion": [0.0, 0.0]}
    pair = {"CameraParameters1": first, "CameraParameters2": second}
    savemat(path, {"stereoParams": {**pair, "RotationOfCamera2": np.eye(3), "TranslationOfCamera2": [-5.0, 0, 0]}})


def own_json(path: Path) -> None:
    cameras = {side: {"K": K.tolist(), "distortion": [-0.1, 0.02, 0, 0, 0]} for side in ("left", "right")}
    path.write_text(json.dumps({**cameras, "R": np.eye(3).tolist(), "T": [-0.005, 0, 0]}))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("stereo.yaml", opencv_yaml),
        ("kalibr.yaml", kalibr_yaml),
        ("stereo.mat", matlab),
        ("calibration.json", own_json),
    ],
)
def test_calibrations_of_other_programs_give_the_same_cameras(folder, name, write: Callable[[Path], None]):
    for file in ("left.yaml", "right.yaml"):
        (folder / file).unlink()
    write(folder / name)
    left, right = find(folder).cameras
    assert left.intrinsics == pytest.approx((110, 110, 47.5, 35.5)) and left.pixel_center == 0.0
    assert left.distortion[:2] == pytest.approx((-0.1, 0.02)) and right.T_camera_world is not None
    assert np.allclose(right.T_camera_world[:3, 3], [-0.005, 0, 0])


def rewrite(name: str, old: str, new: str) -> Callable[[Path], None]:
    def mutate(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return mutate


def shorten(folder: Path) -> None:
    lines = (folder / "log.csv").read_text().splitlines()
    (folder / "log.csv").write_text("\n".join(line.split(",", 1)[1] for line in lines[:4]))


MUTATIONS: dict[str, tuple[Callable[[Path], object], dict, str]] = {
    "fewer rows than images": (shorten, {}, "has 5 images and log.csv has 3 rows.*--frame-rate"),
    "ragged rows": (write("log.csv", "a,b\n1\n"), {"kinematics": Path("log.csv")}, "cells"),
    "no joints": (rewrite("log.csv", "Joint3", "Motor"), {"kinematics": Path("log.csv")}, "are recognized. Give them"),
    "text in a cell": (rewrite("log.csv", "\n1.0,", "\n1.0,x"), {}, "cells that are not numbers"),
    "empty table": (write("log.csv", ""), {"kinematics": Path("log.csv")}, "has no rows"),
    "binary table": (write("log.csv", b"\xff\xfe"), {"kinematics": Path("log.csv")}, "cannot be read"),
    "missing table": (lambda folder: None, {"kinematics": Path("none.csv")}, "none.csv is missing"),
    "wrong column": (lambda folder: None, {"columns": {"yaw": "q9"}}, "has no column 'q9'. It has: image"),
    "broken YAML": (rewrite("left.yaml", "{rows", "{{{{rows"), {}, "cannot be used"),
    "no matrix": (rewrite("left.yaml", "data:", "values:"), {}, "cannot be used"),
    "missing folder": (lambda folder: None, {"images": {"left": "nothing"}}, "nothing is neither a video nor"),
    "cut image": (write("imgs_left/img_0000.png", b"\x89PNG\r\n\x1a\n123"), {}, "damaged"),
    "no common frames": (
        lambda f: [p.rename(p.with_name(f"img_9{p.name[4:]}")) for p in (f / "imgs_left").iterdir()],
        {},
        "every camera",
    ),
    "third camera": (lambda f: write_images(f / "left again", 2), {}, "do not identify the cameras"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_folder_is_an_error_in_words_and_leaves_nothing(folder, tmp_path, name):
    mutate, options, message = MUTATIONS[name]
    mutate(folder)
    with pytest.raises(CartsError, match=message):
        import_recording(folder, tmp_path / "out", ImportOptions(**options))
    assert [entry.name for entry in tmp_path.iterdir()] == [folder.name]


def test_degrees_of_a_small_motion_are_degrees_since_no_wrist_turns_that_far_in_radians(tmp_path):
    write_images(tmp_path / "rec/images", FRAMES)
    angles = np.linspace(-3.5, 3.5, FRAMES)[:, None] * np.ones(6)
    angles[:, 2] = 150.0
    write_csv(tmp_path / "rec/log.csv", ["frame", *(f"q{n}" for n in range(1, 7))], np.column_stack([range(5), angles]))
    found = find(tmp_path / "rec").arms[0].values
    assert found is not None and found[0] == pytest.approx([np.radians(-3.5)] * 2 + [0.15] + [np.radians(-3.5)] * 3)


def test_six_columns_that_differ_in_a_number_are_joints_whatever_they_are_called(tmp_path):
    write_images(tmp_path / "rec/images", FRAMES)
    q = joints_at(np.arange(FRAMES) / 10)
    header = ["picture", *(f"Motor no. {n}" for n in range(6)), "temperature 1", "temperature 2"]
    write_csv(tmp_path / "rec/log.csv", header, np.column_stack([range(5), q, q[:, :2]]))
    found = find(tmp_path / "rec")
    assert found.arms[0].values is not None and np.abs(found.arms[0].values - q).max() < 1e-9
    assert any("joint positions are read from Motor no. 0, Motor no. 1" in str(note) for note in found.notes)


def test_the_default_output_has_the_whole_name_of_a_folder_with_a_dot(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("case.3", "case.4"):
        folder = folder.rename(tmp_path / name)
        main(["import", str(folder)])
        assert Sequence.open(tmp_path / f"{name}_sequence/sequence.toml").name == name


@pytest.mark.parametrize(
    ("times", "change", "message"),
    [
        ([0.0, 0.1, 0.2, 0.15, 0.4], {}, r"Recording \{1\}: row 4 in the log of PSM1"),
        (np.arange(FRAMES) / 10, {"frame_ids": ("a", "b", "b", "c", "d")}, r"Recording \{1\}"),
        (np.arange(FRAMES) / 10, {"name": "a\x1bb"}, "name"),
    ],
)
def test_errors_name_the_recording(
    folder: Path, tmp_path: Path, times: list[float] | np.ndarray, change: dict, message: str
):
    found = find(folder)
    arms = tuple(replace(arm, times=np.array(times)) for arm in found.arms)
    recording = replace(found, arms=arms, frame_times=np.arange(FRAMES) / 10, **change)
    with pytest.raises(CartsError, match=message) as error:
        write_sequence(recording, tmp_path / "out")
    assert "/tmp/tmp" not in str(error.value) and "sequence.toml" not in str(error.value)
