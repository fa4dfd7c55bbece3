"""Sequences: frames, paths and the cache."""

import json
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from pytest import MonkeyPatch

from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.recording import Sequence
from carts_core.recording.images import read_image
from carts_core.resources import shipped_robot


def replaced(old: str, new: str):
    """An edit of a sequence file that fails the test when there is nothing to edit."""

    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return edit


def edit_table(path: Path, edit) -> None:
    """Rewrite a CSV file by a function of its rows (lists of cells, the header first)."""
    rows = [line.split(",") for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join(row) for row in edit(rows)) + "\n")


def test_a_tiny_sequence_gives_frames_with_all_that_the_file_names(tiny_sequence):
    sequence = Sequence.open(tiny_sequence(domains=("regular", "dark"), cameras=("left", "right")))
    assert (len(sequence), sequence.domains, sequence.frame_ids) == (3, ("regular", "dark"), ("001", "002", "003"))
    frame = sequence.frame(2)
    assert (frame.index, frame.frame_id, frame.domain, frame.timestamp) == (2, "003", "regular", 0.2)
    assert set(frame.images) == {"left", "right"}
    assert frame.images["left"].shape == (72, 96, 3)
    assert frame.images["left"].dtype == np.uint8
    assert frame.masks is not None and frame.masks["right"].dtype == bool
    assert frame.truth is not None
    assert not np.allclose(frame.truth["PSM1"], frame.measured["PSM1"])


def test_another_domain_has_other_images_and_the_same_kinematics(tiny_sequence):
    sequence = Sequence.open(tiny_sequence(domains=("regular", "dark")))
    regular, dark = sequence.frame(0), sequence.frame(0, "dark")
    assert dark.images["left"].mean() < 0.7 * regular.images["left"].mean()
    assert np.array_equal(dark.measured["PSM1"], regular.measured["PSM1"])
    assert regular.masks and dark.masks and np.array_equal(dark.masks["left"], regular.masks["left"])


def test_images_are_rgb_in_the_order_red_green_blue(tiny_sequence):
    path = tiny_sequence()
    cv2.imwrite(str(path.parent / "regular/left/001.png"), np.full((72, 96, 3), (10, 20, 200), np.uint8))
    assert Sequence.open(path).frame(0).images["left"][0, 0].tolist() == [200, 20, 10]


def test_only_the_cameras_asked_for_are_decoded(tiny_sequence):
    path = tiny_sequence(cameras=("left", "right"))
    (path.parent / "regular/right/001.png").write_bytes(b"no image")
    assert set(Sequence.open(path).frame(0, cameras=["left"]).images) == {"left"}


def test_writing_into_a_frame_changes_no_other_frame(tiny_sequence):
    sequence = Sequence.open(tiny_sequence())
    first = sequence.frame(0)
    assert first.masks and first.truth
    first.images["left"][:] = 0
    first.masks["left"][:] = True
    first.measured["PSM1"][:] = 0
    first.truth["PSM1"][:] = 0
    again = sequence.frame(0)
    assert again.images["left"].any()
    assert again.masks and not again.masks["left"].all()
    assert again.measured["PSM1"].any()
    assert again.truth and again.truth["PSM1"].any()


def test_threads_read_what_one_reader_reads(tiny_sequence):
    path = tiny_sequence(frames=6)
    expected = [Sequence.open(path).frame(index).images["left"] for index in range(6)]
    sequence = Sequence.open(path)
    wrong: list[int] = []

    def read(seed: int) -> None:
        for index in np.random.default_rng(seed).integers(0, 6, 40):
            if not np.array_equal(sequence.frame(int(index)).images["left"], expected[index]):
                wrong.append(int(index))

    threads = [threading.Thread(target=read, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


def test_without_truth_and_masks_a_frame_has_none(tiny_sequence):
    sequence = Sequence.open(tiny_sequence(masks=False, truth=False, edit=replaced('timestamp = "time"', "")))
    frame = sequence.frame(0)
    assert (frame.truth, frame.masks, frame.timestamp) == (None, None, None)
    assert not sequence.has_masks("left")


def test_some_frames_may_have_masks_if_the_file_says_so(tiny_sequence):
    path = tiny_sequence(edit=replaced('masks = "', 'sparse_masks = true\nmasks = "'))
    (path.parent / "masks/left/002.png").unlink()
    sequence = Sequence.open(path)
    assert sequence.has_masks("left")
    assert sequence.frame(0).masks is not None
    assert sequence.frame(1).masks is None


def test_a_joint_without_a_column_stays_at_its_default_and_counts_as_unmeasured(tiny_sequence):
    path = tiny_sequence(edit=replaced('jaw = "jaw"\n', "[arms.defaults]\njaw = 0.25\n"))
    sequence = Sequence.open(path)
    joints = sequence.scene.arms[0].robot.joint_names
    assert sequence.measured_joints == {"PSM1": tuple(name for name in joints if name != "jaw")}
    assert sequence.frame(1).measured["PSM1"][joints.index("jaw")] == 0.25


def test_degrees_and_millimetres_become_radians_and_metres(tiny_sequence):
    path = tiny_sequence(edit=replaced("[arms.joints]", 'angle_unit = "deg"\nlength_unit = "mm"\n[arms.joints]'))
    metres = Sequence.open(tiny_sequence()).measured["PSM1"]
    path = tiny_sequence(
        truth=False, edit=replaced("[arms.joints]", 'angle_unit = "deg"\nlength_unit = "mm"\n[arms.joints]')
    )

    def convert(rows: list[list[str]]) -> list[list[str]]:
        factors = [1000.0 if name == "insertion" else 180 / np.pi for name in rows[0][2:]]
        return [rows[0]] + [
            row[:2] + [repr(float(cell) * factor) for cell, factor in zip(row[2:], factors, strict=True)]
            for row in rows[1:]
        ]

    edit_table(path.parent / "kinematics.csv", convert)
    assert Sequence.open(path).measured["PSM1"] == pytest.approx(metres)


def test_one_column_may_have_its_own_unit_scale_and_offset(tiny_sequence):
    path = tiny_sequence(
        truth=False, edit=replaced('jaw = "jaw"', 'jaw = { column = "jaw", unit = "deg", scale = -0.5, offset = 0.1 }')
    )
    edit_table(path.parent / "kinematics.csv", lambda rows: [rows[0]] + [[*row[:-1], "60"] for row in rows[1:]])
    assert Sequence.open(path).measured["PSM1"][:, -1] == pytest.approx(0.1 - np.pi / 6)


def test_calibration_may_be_taken_out_of_a_json_file(tiny_sequence):
    expected = Sequence.open(tiny_sequence()).scene.cameras[0]

    def from_json(text: str) -> str:
        lines = []
        for line in text.splitlines():
            key = line.partition(" = ")[0]
            lines.append(f'{key} = "calibration.json#cameras/0/{key}"' if key in ("K", "T_camera_world") else line)
        return "\n".join(lines)

    path = tiny_sequence(edit=from_json)
    values = {"K": expected.K.tolist(), "T_camera_world": expected.T_camera_world.tolist()}
    (path.parent / "calibration.json").write_text(json.dumps({"cameras": [values]}))
    camera = Sequence.open(path).scene.cameras[0]
    assert camera.intrinsics == expected.intrinsics
    assert np.array_equal(camera.T_camera_world, expected.T_camera_world)


def test_intrinsics_may_be_four_numbers_and_opencv_pixel_centres_are_shifted(tiny_sequence):
    def four(text: str) -> str:
        lines = [
            "K = { fx = 100, fy = 101.5, cx = 47, cy = 35.5 }\npixel_center = 0.0" if line.startswith("K = ") else line
            for line in text.splitlines()
        ]
        return "\n".join(lines)

    assert Sequence.open(tiny_sequence(edit=four)).scene.cameras[0].intrinsics == (100.0, 101.5, 47.5, 36.0)


def test_images_and_masks_of_a_distorted_camera_arrive_undistorted(tiny_sequence):
    plain = Sequence.open(tiny_sequence()).frame(1)
    path = tiny_sequence(edit=replaced("size = ", "distortion = [-0.4, 0.1, 0.0, 0.0]\nsize = "))
    sequence = Sequence.open(path)
    camera: Camera = sequence.scene.cameras[0]
    frame = sequence.frame(1)
    assert plain.masks and frame.masks
    assert np.array_equal(frame.images["left"], camera.undistort(plain.images["left"]))
    assert np.array_equal(frame.masks["left"], camera.undistort(plain.masks["left"]))
    assert not np.array_equal(frame.images["left"], plain.images["left"])


def test_cameras_that_share_masks_each_undistort_them(tiny_sequence):
    def edit(text: str) -> str:
        left, right = text.replace("masks/{camera}/", "masks/left/").split('name = "right"')
        return f'{left}name = "right"\ndistortion = [-0.4, 0.1, 0.0, 0.0]{right}'

    sequence = Sequence.open(tiny_sequence(cameras=("left", "right"), edit=edit))
    masks = sequence.frame(1).masks
    assert masks is not None
    assert np.array_equal(masks["right"], sequence.scene.cameras[1].undistort(masks["left"]))
    assert not np.array_equal(masks["right"], masks["left"])


def test_files_may_be_named_by_a_glob_in_natural_order(tiny_sequence):
    path = tiny_sequence(frames=11, edit=replaced("{domain}/{camera}/{frame}.png", "{domain}/{camera}/shot*.png"))
    for row in range(1, 12):
        (path.parent / f"regular/left/{row:03d}.png").rename(path.parent / f"regular/left/shot{row}.png")
    sequence = Sequence.open(path)
    last = read_image(path.parent / "regular/left/shot11.png")
    assert np.array_equal(sequence.frame(10).images["left"], last)
    assert not np.array_equal(sequence.frame(1).images["left"], last)


def test_a_glob_with_several_folders_has_the_files_of_one_folder_after_those_of_another(tiny_sequence):
    path = tiny_sequence(frames=6, edit=replaced("{domain}/{camera}/{frame}.png", "part*/frame*.png"))
    for row in range(6):
        part = path.parent / ("part2" if row < 3 else "part10")
        part.mkdir(exist_ok=True)
        (path.parent / f"regular/left/{row + 1:03d}.png").rename(part / f"frame{row % 3}.png")
    files = [Sequence.open(path).image_file(index, "left") for index in range(6)]
    assert [file and str(file.relative_to(path.parent)) for file in files] == [
        *(f"part2/frame{n}.png" for n in range(3)),
        *(f"part10/frame{n}.png" for n in range(3)),
    ]


def test_the_frame_number_can_be_padded_in_the_pattern(tiny_sequence):
    path = tiny_sequence(
        masks=False, edit=lambda text: text.replace('frame_id = "{frame:03d}"\n', "").replace("{frame}", "{frame:03d}")
    )
    assert Sequence.open(path).frame_ids == ("1", "2", "3")


def test_another_delimiter_can_be_named(tiny_sequence):
    path = tiny_sequence(edit=replaced("[kinematics]", '[kinematics]\ndelimiter = ";"'))
    for name in ("kinematics.csv", "truth.csv"):
        (path.parent / name).write_text((path.parent / name).read_text().replace(",", ";"))
    assert len(Sequence.open(path)) == 3


def test_the_light_can_be_set(tiny_sequence):
    path = tiny_sequence(
        edit=replaced("[kinematics]", "[light]\nposition = [0, 0.01, -0.05]\nambient = 0.5\n[kinematics]")
    )
    light = Sequence.open(path).scene.light
    assert (light.position, light.ambient, light.diffuse) == ((0, 0.01, -0.05), 0.5, 0.75)


def test_a_given_background_is_used_and_an_estimated_one_shows_no_arm(tiny_sequence):
    path = tiny_sequence(width=160, height=120)
    estimated = Sequence.open(path).background("left")
    frame = Sequence.open(path).frame(0)
    assert frame.masks is not None
    assert frame.images["left"][frame.masks["left"]].min() < 40 < estimated.min()
    cv2.imwrite(str(path.parent / "empty.png"), np.full((120, 160, 3), 77, np.uint8))
    path.write_text(path.read_text().replace('images = "', 'background = "empty.png"\nimages = "'))
    assert (Sequence.open(path).background("left") == 77).all()


@pytest.fixture
def cold_cache(tmp_path: Path, monkeypatch: MonkeyPatch) -> None:
    monkeypatch.delenv("CARTS_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cold"))


@pytest.fixture
def robot_folder(tmp_path: Path) -> Path:
    """A copy of the shipped robot."""
    return Path(shutil.copytree(shipped_robot().parent, tmp_path / "recordings" / "robots" / "mine"))


@pytest.mark.usefixtures("cold_cache")
def test_a_sequence_by_a_relative_path_has_its_images_after_the_working_directory_changed(
    tiny_sequence: Callable[..., Path], robot_folder: Path, tmp_path: Path, monkeypatch: MonkeyPatch
):
    mine = "recordings/robots/mine/psm_lnd.urdf"
    path = tiny_sequence(edit=lambda text: text.replace("builtin:psm_lnd", mine))
    monkeypatch.chdir(path.parent.parent)
    sequence = Sequence.open(Path(path.parent.name) / path.name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert sequence.frame(0).images["left"].any()
    assert sequence.path == path and sequence.scene.arms[0].robot.urdf == robot_folder / "psm_lnd.urdf"


@pytest.mark.usefixtures("cold_cache")
@pytest.mark.parametrize("layout", ["package beside urdf", "package above", "absolute", "file address"])
def test_meshes_are_found_as_ros_lays_packages_out(robot_folder: Path, monkeypatch: MonkeyPatch, layout: str):
    text = (robot_folder / "psm_lnd.urdf").read_text()
    package = robot_folder.parent / "psm_description"
    (package / "urdf").mkdir(parents=True)
    shutil.move(robot_folder / "meshes", package / "meshes")
    start = {
        "package beside urdf": "package://psm_description/meshes/",
        "package above": "package://psm_description/meshes/",
        "absolute": f"{package}/meshes/",
        "file address": f"file://{package}/meshes/",
    }[layout]
    folder = robot_folder if layout == "package above" else package / "urdf"
    (folder / "arm.urdf").write_text(text.replace('"meshes/', f'"{start}'))
    monkeypatch.chdir(folder.parent)
    assert Robot.load(f"{folder.name}/arm.urdf").meshes
