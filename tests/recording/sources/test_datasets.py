"""SurgPose, EndoVis and JIGSAWS in the layouts of their owners, from one command to a sequence."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from recordings import SIZE, K, assert_refused, copied, image, joints_at, remove, write, write_images
from videos import write_video

from carts_core.errors import SequenceError
from carts_core.model.psm_kinematics import forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording

FRAMES = 5


def calibration_ini() -> str:
    """Pixels count from 1 in this file, and lengths are millimetres."""
    one = f"fc_x=110\nfc_y=110\ncc_x={K[0, 2] + 1}\ncc_y={K[1, 2] + 1}\nkc_0=-0.1\nkc_1=0.02\n"
    one += f"res_x={SIZE[0]}\nres_y={SIZE[1]}\n"
    turn = "".join(f"R_{index}={value}\n" for index, value in enumerate(np.eye(3).reshape(-1)))
    return f"[StereoLeft]\n{one}[StereoRight]\n{one}{turn}T_0=-5.0\nT_1=0\nT_2=0\n"


def surgpose(folder: Path) -> Path:
    for side in ("left", "right"):
        write_video(folder / f"regular/{side}_video.mp4", [image(number, side) for number in range(FRAMES)])
    rows = {str(n): {"PSM1": joints_at(n / 30).tolist(), "PSM3": joints_at(1 + n / 30).tolist()} for n in range(FRAMES)}
    (folder / "api_jp_data.yaml").write_text(yaml.safe_dump(rows))
    (folder / "StereoCalibrationDVRK.ini").write_text(calibration_ini())
    return folder


def endovis(folder: Path) -> Path:
    for side in ("left", "right"):
        write_images(folder / f"{side}_frames", FRAMES, "frame{:03d}.png", side)
    lines = [f"Camera-{n}-F: 110 110\nCamera-{n}-C: 47.5 35.5\nCamera-{n}-K: -0.1 0.02 0 0 0\n" for n in (0, 1)]
    text = "".join(lines) + "Extrinsic-Omega: 0 0 0\nExtrinsic-T: -5.0 0.0 0.0\n"
    (folder / "camera_calibration.txt").write_text(text)
    return folder


def jigsaws(folder: Path) -> Path:
    for number, side in ((1, "left"), (2, "right")):
        pictures = [image(index, side) for index in range(FRAMES)]
        write_video(folder / f"video/Suturing_B001_capture{number}.avi", pictures, rate=30)
    rows = np.zeros((FRAMES, 76))
    for first in (38, 57):
        Ts = forward(joints_at(np.arange(FRAMES) / 30))
        rows[:, first : first + 3] = Ts[:, :3, 3]
        rows[:, first + 3 : first + 12] = Ts[:, :3, :3].reshape(-1, 9)
        rows[:, first + 18] = 0.4
    path = folder / "kinematics/AllGestures/Suturing_B001.txt"
    path.parent.mkdir(parents=True)
    np.savetxt(path, rows)
    return path


def test_a_trajectory_of_surgpose_has_both_arms_and_its_stereo_calibration(tmp_path):
    file, _ = import_recording(surgpose(tmp_path / "000000"), tmp_path / "out")
    sequence = Sequence.open(file)
    frame = sequence.frame(3)
    assert np.abs(frame.measured["PSM1"][:6] - joints_at(0.1)).max() < 1e-8
    assert np.abs(frame.measured["PSM3"][:6] - joints_at(1.1)).max() < 1e-8
    assert np.abs(frame.images["right"].astype(int) - image(3, "right")).mean() < 6
    left, right = sequence.scene.cameras
    assert left.intrinsics == pytest.approx((110, 110, 48, 36)) and left.distortion[:2] == (-0.1, 0.02)
    assert np.allclose(right.T_camera_world[:3, 3], [-0.005, 0, 0])


def test_a_sequence_of_endovis_has_its_cameras_and_no_arm_in_view(tmp_path):
    file, found = import_recording(endovis(tmp_path / "instrument_dataset_1"), tmp_path / "out")
    sequence = Sequence.open(file)
    assert np.array_equal(sequence.frame(4).images["left"].shape, (SIZE[1], SIZE[0], 3))
    left, right = sequence.scene.cameras
    assert left.intrinsics == pytest.approx((110, 110, 48, 36))
    assert np.allclose(right.T_camera_world[:3, 3], [-0.005, 0, 0])
    assert any("behind the camera" in str(note) for note in found.notes)


def test_images_with_a_table_are_no_sequence_of_endovis(tmp_path):
    path = endovis(tmp_path / "own")
    (path / "camera_calibration.txt").unlink()
    q, header = joints_at(np.arange(FRAMES) / 10), "q1,q2,q3,q4,q5,q6"
    np.savetxt(path / "joints.csv", q, delimiter=",", header=header, comments="")
    found = find(path)
    assert found.kind == "a folder with images and a table" and len(found.arms) == 1


def test_frames_of_1920_x_1080_lose_their_black_rim(tmp_path):
    folder = tmp_path / "seq_1/left_frames"
    folder.mkdir(parents=True)
    picture = np.zeros((1080, 1920, 3), np.uint8)
    picture[28:1052, 320:1600] = 90
    assert cv2.imwrite(str(folder / "frame000.png"), picture)
    file, _ = import_recording(tmp_path / "seq_1", tmp_path / "out")
    seen = Sequence.open(file).frame(0).images["left"]
    assert seen.shape == (1024, 1280, 3) and (seen == 90).all()


def test_a_trial_of_jigsaws_gets_its_joints_by_inverse_kinematics(tmp_path):
    file, _ = import_recording(jigsaws(tmp_path / "Suturing"), tmp_path / "out")
    sequence = Sequence.open(file)
    frame = sequence.frame(2)
    assert np.abs(frame.measured["PSM_left"][:6] - joints_at(2 / 30)).max() < 1e-6
    assert frame.measured["PSM_right"][6] == pytest.approx(0.4)
    assert [camera.name for camera in sequence.scene.cameras] == ["left", "right"]


@pytest.mark.parametrize("root", ["", "Suturing", "Suturing/kinematics"])
def test_a_folder_of_jigsaws_names_its_trials_and_the_command(tmp_path, root):
    first = jigsaws(tmp_path / "JIGSAWS set/Suturing")
    folder = tmp_path / "JIGSAWS set" / root
    if root != "Suturing/kinematics":
        assert find(folder).name == "Suturing_B001", "the only trial"
    shutil.copy(first, first.with_name("Suturing_B002.txt"))
    with pytest.raises(SequenceError, match="2 trials of JIGSAWS: Suturing_B001, Suturing_B002") as error:
        find(folder)
    assert f"carts import '{first}'" in str(error.value)


def rewritten(name: str, old: str, new: str) -> Callable[[Path], object]:
    def mutate(path: Path) -> None:
        folder = path if path.is_dir() else path.parents[2]
        file = folder / name
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new))

    return mutate


MUTATIONS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object], str]] = {
    "SurgPose, cut YAML": (surgpose, write("api_jp_data.yaml", "'0': {"), "does not map frames to"),
    "SurgPose, no arms": (surgpose, write("api_jp_data.yaml", "'0': {}"), "no joint positions of"),
    "SurgPose, texts": (surgpose, write("api_jp_data.yaml", "'0': {PSM1: [a, b, c, d, e, f]}"), "are not numbers"),
    "SurgPose, five joints": (
        surgpose,
        write("api_jp_data.yaml", "'0': {PSM1: [0, 0, 0, 0, 0]}"),
        "needs six joint positions",
    ),
    "SurgPose, other frames": (surgpose, rewritten("api_jp_data.yaml", "':", "9':"), "no frame has joint positions"),
    "SurgPose, no right video": (surgpose, remove("regular/right_video.mp4"), "right_video.mp4"),
    "SurgPose, calibration": (surgpose, rewritten("StereoCalibrationDVRK.ini", "fc_x", "f"), "cannot be used"),
    "EndoVis, calibration": (endovis, rewritten("camera_calibration.txt", "Camera-1-F", "F"), "has no readable"),
    "EndoVis, no common frame": (
        endovis,
        lambda p: [f.rename(f.with_name(f"frame9{f.name[5:]}")) for f in (p / "right_frames").iterdir()],
        "no frame has an image of every camera",
    ),
    "JIGSAWS, other columns": (jigsaws, lambda p: p.write_text("1 2 3\n"), "has 76 columns"),
    "JIGSAWS, ragged": (jigsaws, lambda p: p.write_text("1 2 3\n1 2\n"), "is not a table of numbers"),
    "JIGSAWS, no rotations": (jigsaws, lambda p: np.savetxt(p, np.zeros((3, 76))), "are not rotations"),
    "JIGSAWS, no video": (
        jigsaws,
        lambda p: [f.unlink() for f in (p.parents[2] / "video").iterdir()],
        "has no Suturing_B001_capture1.avi",
    ),
    "JIGSAWS, other frame": (
        jigsaws,
        lambda p: np.savetxt(p, np.loadtxt(p) + np.array([9.0 * (c in (38, 39, 40)) for c in range(76)])),
        "poses are unreachable",
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_recording_is_an_error_in_words(tmp_path, name):
    make, mutate, message = MUTATIONS[name]
    path = copied(make, tmp_path / "source")
    mutate(path)
    assert_refused(path, message)


def test_endovis_without_a_calibration_gets_a_stand_in(tmp_path):
    path = endovis(tmp_path / "seq_1")
    (path / "camera_calibration.txt").unlink()
    assert any("a placeholder focal length" in str(note) for note in find(path).notes)
