"""ROS bags, written by rosbags' own writers, from one command to images with joints and an overlay."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import (
    SIZE,
    START,
    T_CAMERA_BASE,
    BagKind,
    K,
    endoscope_at,
    image,
    jaw_at,
    joints_at,
    pose_of,
    write_bag,
    write_images,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from videos import write_video

from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.errors import CartsError
from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.model.ecm_kinematics import forward as ecm
from carts_core.model.psm_kinematics import forward
from carts_core.recording import Sequence
from carts_core.recording.importing.found import Import, Track
from carts_core.recording.importing.importer import find, import_recording
from carts_core.recording.importing.logs import ArmLog, arm_from_log, track
from carts_core.rendering import Renderer
from carts_core.settings.interchange import ImportOptions

KINDS = {
    "ROS 2 sqlite3, dVRK 2.2": ("bag", BagKind()),
    "ROS 2 MCAP, dVRK 2.0, raw images": ("bag", BagKind(storage="mcap", generation="2.0", compressed=False)),
    "ROS 1, dVRK 2.2, raw images": ("rec.bag", BagKind(ros=1, compressed=False)),
    "ROS 1, dVRK 1.x": ("rec.bag", BagKind(ros=1, generation="1.x")),
    "poses only": ("bag", BagKind(joints=False)),
}


def rendered_pixels(sequence: Sequence, index: int, camera: str) -> int:
    """How much of an image the arms cover in the overlay."""
    renderer = Renderer(sequence.scene, cameras=[camera])
    state = sequence.scene.state({arm: rows[index] for arm, rows in sequence.measured.items()})
    return int((renderer.segment(state)[0] >= 0).sum())


@pytest.mark.parametrize(("name", "kind"), KINDS.values(), ids=KINDS)
def test_one_command_makes_a_sequence_with_images_joints_and_overlay(tmp_path: Path, name: str, kind: BagKind) -> None:
    path = write_bag(tmp_path / name, kind)
    main(["import", str(path), "-o", str(tmp_path / "out")])
    sequence = Sequence.open(tmp_path / "out/sequence.toml")
    assert len(sequence) == kind.frames
    assert sequence.timestamps is not None
    assert np.allclose(np.diff(sequence.timestamps), 0.08, atol=1e-6), "of the headers, not of the bag"
    for index in (kind.frames - 1, 0, 2):
        frame = sequence.frame(index)
        time = 0.08 * index
        assert np.array_equal(frame.images["left"], image(index)), "the image of this frame"
        assert np.array_equal(frame.images["right"], image(index, "right"))
        assert np.abs(frame.measured["PSM1"][:6] - joints_at(time)).max() < 2e-3
        assert frame.measured["PSM1"][6] == pytest.approx(float(jaw_at(time)), abs=1e-3)
    left, right = sequence.scene.cameras
    assert left.intrinsics == pytest.approx((110, 110, K[0, 2] + 0.5, K[1, 2] + 0.5))
    assert np.allclose(right.T_camera_world[:3, 3], [-0.005, 0, 0])
    assert np.allclose(sequence.scene.arms[0].T_world_base, T_CAMERA_BASE, atol=2e-3)
    assert rendered_pixels(sequence, 2, "left") > 50


def test_the_report_says_what_was_found_and_what_is_missing(tmp_path, capsys):
    main(["import", str(write_bag(tmp_path / "bag", BagKind(cameras=("left",)))), "-o", str(tmp_path / "out")])
    said = " ".join(capsys.readouterr().out.split())
    assert "6 frames, 0.4 s, 12.5 images/s" in said
    assert "PSM1: 58 rows, 100.0 rows/s" in said
    assert "left: /stereo/left/image_raw/compressed, 6 images, 96 x 72" in said
    assert "joints and tip poses are consistent with a 9.1 mm wrist" in said
    assert "tool_type is LARGE_NEEDLE_DRIVER:400006[1]" in said
    assert "wrote" in said and "carts view" in said


def test_base_frames_come_from_what_the_bag_knows_of_itself(tmp_path):
    path = write_bag(tmp_path / "bag", BagKind(generation="1.x", joints=True))
    recording = find(path)
    assert any("base frame from" in str(note) for note in recording.notes)
    # A bag with local poses only does not know where the camera is.
    kind = replace(BagKind(joints=False, cameras=("left",)), local=True)
    bag = write_bag(tmp_path / "local", kind)
    (path, found) = import_recording(bag, tmp_path / "out", ImportOptions())
    assert rendered_pixels(Sequence.open(path), 0, "left") > 50
    assert found.arms[0].base_from == "measured_cp and local/measured_cp"


@pytest.mark.parametrize("topic", ["measured_cp", "local/measured_cp", "measured_js"])
def test_an_endoscope_that_moves_gives_the_cameras_a_motion(tmp_path: Path, topic: str) -> None:
    path = write_bag(tmp_path / "bag", BagKind(endoscope=topic, frames=10))
    file, found = import_recording(path, tmp_path / "out", ImportOptions())
    sequence = Sequence.open(file)
    assert sequence.moving_cameras == ("left", "right")
    first = ecm(endoscope_at(0.0))
    for index in (0, 4, 9):
        moved = T_DVRK_OPENCV @ np.linalg.inv(ecm(endoscope_at(0.08 * index))) @ first @ T_DVRK_OPENCV
        assert np.allclose(sequence.mounts(index)["left"], moved, atol=2e-4)
    assert any("the endoscope (ECM) moves by up to" in str(note) for note in found.notes)


def test_an_endoscope_that_stands_still_is_a_camera_as_any_other(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("recordings.endoscope_at", lambda time: np.array([0.1, -0.2, 0.11, 0.3]))
    path = write_bag(tmp_path / "bag", BagKind(endoscope="measured_js"))
    file, found = import_recording(path, tmp_path / "out", ImportOptions())
    assert not Sequence.open(file).moving_cameras and not (tmp_path / "out" / "endoscope.csv").exists()
    assert any(str(note) == "the endoscope (ECM) is static." for note in found.notes)


def test_poses_of_a_moving_endoscope_give_the_base_frame_at_the_first_image() -> None:
    times = np.arange(100) / 50
    mount = np.tile(np.eye(4), (len(times), 1, 1))
    mount[:, :3, 3] = np.outer(np.sin(times), [0.02, 0.01, 0.03])
    in_camera = T_DVRK_OPENCV @ np.linalg.inv(mount) @ T_CAMERA_BASE @ forward(joints_at(times))
    poses = track(times, np.array([pose_of(T) for T in in_camera]))
    motion, job = Track(times, mount), Import(ImportOptions())
    for joints in (track(times, joints_at(times)), None):
        local = None if joints else track(times, np.array([pose_of(T) for T in forward(joints_at(times))]))
        arm = arm_from_log(ArmLog("PSM1", joints, poses=poses, local_poses=local), job, 0.0, motion)
        assert arm.T_world_base is not None and np.allclose(arm.T_world_base, T_CAMERA_BASE, atol=1e-6)
    assert not [note for note in job.notes if note.kind == "warning"]


def test_signs_of_joints_can_be_changed_beside_a_jaw_topic(tmp_path: Path) -> None:
    found = find(write_bag(tmp_path / "bag", BagKind(cameras=("left",))), ImportOptions(flip=("yaw",)))
    expected = find(tmp_path / "bag").arms[0].values
    values = found.arms[0].values
    assert values is not None and expected is not None and np.allclose(values[:, 0], -expected[:, 0])


def test_a_base_frame_of_another_arm_or_of_the_cart_is_a_warning(tmp_path: Path) -> None:
    path, file = write_bag(tmp_path / "bag", BagKind(cameras=("left",))), tmp_path / "PSM2-registration-open-cv.json"
    frame = {"reference-frame": "SUJ_Cart", "transform": T_CAMERA_BASE.tolist()}
    file.write_text(json.dumps({"base-frame": frame}))
    notes = [str(note) for note in find(path, ImportOptions(base={"PSM1": file})).notes if note.kind == "warning"]
    assert any("has the base frame of PSM2" in note for note in notes)
    assert any("is relative to SUJ_Cart, not to the camera" in note for note in notes)


def test_a_given_calibration_replaces_an_unusable_camera_info(tmp_path: Path) -> None:
    def fisheye(values: dict) -> None:
        values["distortion_model"] = "equidistant"

    path = write_bag(tmp_path / "bag", BagKind(cameras=("left",), info=fisheye))
    with pytest.raises(CartsError, match="--calibration left FILE"):
        find(path)
    (tmp_path / "left.json").write_text(json.dumps({"K": K.tolist(), "D": [0, 0, 0, 0]}))
    found = find(path, ImportOptions(calibration={"left": tmp_path / "left.json"}))
    assert found.cameras[0].intrinsics == (110, 110, 47.5, 35.5)


def test_a_bag_without_images_gets_those_of_a_video_beside_it(tmp_path: Path, capsys) -> None:
    path = write_bag(tmp_path / "bag", BagKind(cameras=(), frames=10))
    write_video(tmp_path / "left.mp4", [image(number) for number in range(10)], rate=20)
    main(["import", str(path), "--images", "left", "left.mp4", "-o", str(tmp_path / "out")])
    said = " ".join(capsys.readouterr().out.split())
    assert "the clocks do not overlap; a common start of images and kinematics is assumed" in said
    assert "carts time-offset" in said
    sequence = Sequence.open(tmp_path / "out" / "sequence.toml")
    assert len(sequence) == 10 and sequence.timestamps is not None
    assert np.allclose(np.diff(sequence.timestamps), 0.05)
    # The log begins 50 ms before the images of a bag would.
    assert np.abs(sequence.frame(4).measured["PSM1"][:6] - joints_at(0.2 - 0.05)).max() < 2e-3
    assert np.abs(sequence.frame(4).images["left"].astype(int) - image(4)).mean() < 12
    assert rendered_pixels(sequence, 4, "left") > 50
    clock = ["--time-offset", f"{START * 1e-9}"]
    main(["import", str(path), "--images", "left", "left.mp4", *clock, "-o", str(tmp_path / "own")])
    timed = Sequence.open(tmp_path / "own" / "sequence.toml")
    assert np.abs(timed.frame(4).measured["PSM1"][:6] - joints_at(0.2)).max() < 2e-3


def test_images_beside_a_bag_without_times_are_asked_for_their_rate(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", BagKind(cameras=("right",)))
    write_images(tmp_path / "pictures", 5)
    with pytest.raises(CartsError, match=r"have no times\. Give their frame rate\. Use --frame-rate"):
        import_recording(path, tmp_path / "out", ImportOptions(images={"left": "pictures"}))
    file, _ = import_recording(path, tmp_path / "out", ImportOptions(images={"left": "pictures"}, frame_rate=20))
    assert np.array_equal(Sequence.open(file).frame(3).images["left"], image(3))
    both = {"left": "pictures", "right": "/stereo/right/image_raw/compressed"}
    with pytest.raises(CartsError, match="some images are topics of the bag, others are files"):
        import_recording(path, tmp_path / "both", ImportOptions(images=both, frame_rate=20))


def test_the_user_chooses_topics_arms_and_the_time_offset(tmp_path):
    path = write_bag(tmp_path / "bag", BagKind(arms=("PSM1", "PSM2")))
    options = ImportOptions(
        images={"eye": "/stereo/right/image_raw/compressed"}, arms={"tool": "PSM2"}, time_offset=0.02
    )
    file, _ = import_recording(path, tmp_path / "out", options)
    sequence = Sequence.open(file)
    assert [camera.name for camera in sequence.scene.cameras] == ["eye"]
    assert [arm.name for arm in sequence.scene.arms] == ["tool"]
    # Images of the right camera are a millisecond later.
    assert np.abs(sequence.frame(1).measured["tool"][:6] - joints_at(0.101)).max() < 2e-3


def _cut(path: Path) -> None:
    (file,) = [path] if path.is_file() else [each for each in path.iterdir() if each.suffix in (".db3", ".mcap")]
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


@pytest.mark.parametrize(
    ("name", "kind"),
    [("rec.bag", BagKind(ros=1)), ("bag", BagKind(storage="mcap")), ("bag", BagKind())],
    ids=["ROS 1", "MCAP", "sqlite3"],
)
def test_a_truncated_bag_is_an_error_in_words_and_leaves_nothing(tmp_path, capsys, name, kind):
    path = write_bag(tmp_path / name, kind)
    _cut(path)
    with pytest.raises(SystemExit) as stopped:
        main(["import", str(path), "-o", str(tmp_path / "out")])
    assert stopped.value.code == BAD_INPUT
    said = capsys.readouterr().err
    assert "Traceback" not in said and str(path) in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (BagKind(arms=()), {}, "has no kinematics of an arm .*looked for.*Its topics are"),
        (BagKind(cameras=()), {}, "no images were found.*--images"),
        (BagKind(), {"images": {"left": "/nothing"}}, "has no image topic '/nothing'. It has: /stereo/left"),
        (BagKind(cameras=("one", "two")), {}, "names contain neither left nor right.*--images left TOPIC right TOPIC"),
        (BagKind(), {"time_offset": 100.0}, "no frame has joint positions.*clocks|Clocks"),
        (BagKind(), {"base": {"PSM1": Path("none.json")}}, "none.json is missing"),
        (BagKind(), {"calibration": {"left": Path("none.yaml")}}, "calibration none.yaml is missing"),
    ],
)
def test_what_contradicts_or_is_missing_is_an_error_in_words(tmp_path, kind, options, message):
    path = write_bag(tmp_path / "bag", kind)
    with pytest.raises(CartsError, match=message):
        import_recording(path, tmp_path / "out", ImportOptions(**options))
    assert not (tmp_path / "out").exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ["bag"]


def test_frames_without_kinematics_are_left_out_and_said(tmp_path):
    path = write_bag(tmp_path / "bag", BagKind(frames=8))
    found = find(path, ImportOptions(time_offset=-0.3))
    assert 3 <= len(found.frame_ids) < 8
    assert any(": no joint positions within 0.1 s" in str(note) for note in found.notes)


def test_a_calibration_that_a_camera_lacks_gets_a_stand_in(tmp_path):
    path = write_bag(tmp_path / "bag", BagKind(info=lambda values: values.update(K=np.zeros(9))))
    found = find(path)
    assert found.cameras[0].intrinsics == pytest.approx((1.2 * SIZE[0], 1.2 * SIZE[0], 48, 36))
    assert any(note.kind == "missing" and "focal length" in str(note) for note in found.notes)


def test_unknown_sources_get_a_list_of_what_was_looked_for(tmp_path):
    with pytest.raises(CartsError, match=r"(?s)not a recording of a supported format.*\n  bag: a ROS 1 or ROS 2 bag"):
        find(tmp_path)
    with pytest.raises(CartsError, match="is missing"):
        find(tmp_path / "nothing")
    with pytest.raises(CartsError, match="the format 'rosbag' is unknown"):
        find(tmp_path, ImportOptions(source="rosbag"))


def test_the_real_bag_says_itself_what_it_is(shared_dir):
    path = shared_dir / "data/dvrk_bag/pitch_exp_traj_01_test_cropped.bag"
    with pytest.raises(CartsError, match="no images were found"):
        find(path)


def test_one_file_of_a_compressed_bag_asks_for_the_folder(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    text = store.types["std_msgs/msg/String"](data="hello")
    with writer:
        connection = writer.add_connection("/PSM1/tool_type", text.__msgtype__, typestore=store)
        writer.write(connection, START, store.serialize_cdr(text, text.__msgtype__))
    (file,) = (tmp_path / "bag").glob("*.db3*")
    with pytest.raises(CartsError, match=r"one file of the ROS 2 bag .*Give the folder"):
        find(file)


@pytest.mark.parametrize(
    ("name", "remedy"),
    [("run.bag.active", "rosbag reindex"), ("run.mcap.zstd", "zstd -d"), ("run_0.db3.zstd", "Give the folder")],
)
def test_bags_that_need_another_program_first_say_which(tmp_path, name, remedy):
    (tmp_path / name).write_bytes(b"\x28\xb5\x2f\xfd" + bytes(100))
    with pytest.raises(CartsError, match=remedy):
        find(tmp_path / name)
