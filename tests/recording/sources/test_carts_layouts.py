"""CTS, AMBF and SegSTRONG-C folders, from one command to images, masks and joints."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import SIZE, assert_refused, copied, image, joints_at, save, write_images

from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording

FRAMES = 4


def write_masks(folder: Path, frames: int = FRAMES, value: int = 255) -> None:
    folder.mkdir(parents=True)
    for number in range(frames):
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        mask[: number + 2] = value
        assert cv2.imwrite(str(folder / f"{number}.png"), mask)


def cts(folder: Path) -> Path:
    for domain in ("regular", "smoke", "green_screen"):
        write_images(folder / domain / "images_l", FRAMES, "{}.png")
    write_masks(folder / "green_screen/ground_truth_l")
    q = joints_at(np.arange(FRAMES) / 10)
    for arm in (1, 2):
        np.save(folder / f"green_screen/psm{arm}_js.npy", np.stack([arm * q / 2, q * 0, q * 0], 1))
    return folder


def ambf(folder: Path) -> Path:
    write_images(folder / "images", FRAMES, "{}.png")
    write_masks(folder / "segmentations")
    q = joints_at(np.arange(FRAMES) / 10) * [1, 1, 10, 1, 1, 1]
    jaw = np.full((FRAMES, 2), 0.2)
    np.save(folder / "kinematics.npy", np.column_stack([q, jaw, q, jaw]))
    return folder


def segstrong(folder: Path) -> Path:
    for camera in ("left", "right"):
        for domain in ("regular", "blood", "smoke"):
            write_images(folder / domain / camera, FRAMES, "{}.png", camera)
        write_masks(folder / "ground_truth" / camera)
    return folder


def test_a_set_of_cts_has_its_domains_masks_and_both_arms(tmp_path):
    file, found = import_recording(cts(tmp_path / "set-1"), tmp_path / "out")
    sequence = Sequence.open(file)
    assert sequence.domains == ("regular", "green_screen", "smoke") and len(sequence) == FRAMES
    frame = sequence.frame(2, "smoke")
    assert np.array_equal(frame.images["left"], image(2))
    assert frame.masks is not None and frame.masks["left"].sum() == 4 * SIZE[0]
    assert np.abs(frame.measured["PSM1"][:6] - joints_at(0.2) / 2).max() < 1e-8
    assert np.abs(frame.measured["PSM2"][:6] - joints_at(0.2)).max() < 1e-8
    assert {note.kind for note in found.notes} == {"found", "missing"}


def test_a_simulated_video_has_its_camera_and_insertion_in_metres(tmp_path):
    file, found = import_recording(ambf(tmp_path / "run{1}/Video_01"), tmp_path / "out")
    sequence = Sequence.open(file)
    frame = sequence.frame(3)
    assert np.abs(frame.measured["PSM2"][:6] - joints_at(0.3)).max() < 1e-8
    assert frame.measured["PSM1"][6] == pytest.approx(0.4)
    assert sequence.scene.cameras[0].intrinsics[0] == pytest.approx(36 / np.tan(0.6))
    assert frame.masks is not None
    assert any("decimetres" in str(note) for note in found.notes)


def test_a_subset_of_segstrong_has_masks_and_no_arm_in_view(tmp_path):
    file, found = import_recording(segstrong(tmp_path / "train/3/0"), tmp_path / "out")
    sequence = Sequence.open(file)
    assert sequence.domains == ("regular", "blood", "smoke")
    frame = sequence.frame(1, "blood")
    assert np.array_equal(frame.images["right"], image(1, "right"))
    assert frame.masks is not None and frame.masks["right"].sum() == 3 * SIZE[0]
    assert any("behind the camera" in str(note) for note in found.notes)
    assert sequence.scene.arms[0].T_world_base[2, 3] == -1.0


def test_a_whole_challenge_is_asked_about_by_the_names_of_its_subsets(tmp_path):
    segstrong(tmp_path / "data/train/3/0")
    segstrong(tmp_path / "data/train/3/2")
    with pytest.raises(CartsError, match=r"several recordings\. Import one of them: train/3/0, train/3/2"):
        find(tmp_path / "data")


def test_label_images_are_no_masks_and_that_is_said(tmp_path):
    path = ambf(tmp_path / "Video_01")
    for file in (path / "segmentations").iterdir():
        file.unlink()
    (path / "segmentations").rmdir()
    write_masks(path / "segmentations", value=31)
    found = find(path)
    assert not found.cameras[0].masks and any("has no value above 31. Masks are 0" in str(note) for note in found.notes)


def test_missing_images_of_one_domain_are_left_out_in_all(tmp_path):
    path = cts(tmp_path / "set-1")
    (path / "smoke/images_l/2.png").unlink()
    found = find(path)
    assert found.frame_ids == ("0", "1", "3")
    assert found.arms[0].values is not None and np.allclose(found.arms[0].values[2], joints_at(0.3) / 2)


MUTATIONS = {
    "too few rows": (cts, save("green_screen/psm1_js.npy", np.zeros((2, 3, 6))), "2 rows for 4 images"),
    "not finite": (cts, save("green_screen/psm1_js.npy", np.full((4, 3, 6), np.nan)), "six finite"),
    "five joints": (cts, save("green_screen/psm1_js.npy", np.zeros((4, 3, 5))), "six finite"),
    "pickled table": (cts, save("green_screen/psm1_js.npy", np.array([{}], object)), "cannot be read"),
    "no kinematics": (
        cts,
        lambda p: [(p / f"green_screen/psm{arm}_js.npy").unlink() for arm in (1, 2)],
        "has no psm1_js.npy",
    ),
    "no common frame": (
        cts,
        lambda p: [f.rename(f.with_name(f"{int(f.stem) + 10}.png")) for f in (p / "smoke/images_l").iterdir()],
        "no frame has an image of every camera and domain",
    ),
    "other names": (
        cts,
        lambda p: [f.rename(f.with_name(f"a{f.name}")) for f in (p / "smoke/images_l").iterdir()],
        "differ between domains",
    ),
    "seven columns": (ambf, save("kinematics.npy", np.zeros((4, 7))), "eight columns"),
    "texts": (ambf, save("kinematics.npy", np.full((4, 8), "a")), "eight columns"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_set_is_an_error_in_words_and_leaves_nothing(tmp_path, name):
    make, mutate, message = MUTATIONS[name]
    path = copied(make, tmp_path / "set-1")
    mutate(path)
    assert_refused(path, message)
