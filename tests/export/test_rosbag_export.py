"""ROS 2 bags of results, read back with rosbags."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from corrected_frames import corrected
from recordings import BagKind, digests, write_bag
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from carts_core.export import Dataset, ExportProgress, export
from carts_core.export.rosbag_format import psm_geometry
from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.model.psm_kinematics import CLASSIC, forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import import_recording

ROS_TO_NS = 10**9


def messages(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Topic -> record time [ns] and message."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((time, reader.deserialize(raw, connection.msgtype)))
    return found


def stamp_of(message: Any) -> int:
    return message.header.stamp.sec * ROS_TO_NS + message.header.stamp.nanosec


def matrix(pose: Any) -> np.ndarray:
    p, q = pose.position, pose.orientation
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = (p.x, p.y, p.z), Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    return T


def test_results_of_a_bag_have_its_clock_and_are_equal_to_the_project(tmp_path):
    source = write_bag(tmp_path / "bag", BagKind(cameras=("left",), storage="mcap"))
    before = digests(source)
    sequence = Sequence.open(import_recording(source, tmp_path / "sequence")[0])
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")
    out = export(data, "rosbag2", tmp_path / "out")
    assert digests(source) == before
    found, recorded = messages(out), messages(source)
    images = recorded["/stereo/left/image_raw/compressed"]
    stamps = [(time, stamp_of(message)) for time, message in images]
    (arm,) = sequence.scene.arms
    T = T_DVRK_OPENCV @ sequence.scene.cameras[0].T_camera_world @ arm.T_world_base
    for topic in ("measured_js", "std_js", "jaw/measured_js", "jaw/std_js", "measured_cp", "local/measured_cp"):
        own = found[f"/PSM1/corrected/{topic}"]
        assert [(time, stamp_of(message)) for time, message in own] == stamps
        for frame, (_, message) in zip(data.frames, own, strict=True):
            positions = frame.joint_positions["PSM1"]
            std = (frame.joint_std or {}).get("PSM1", np.full(7, np.nan))
            if topic.endswith("js"):
                values = positions if "measured" in topic else std
                expected = values[6:] if topic.startswith("jaw") else values[:6]
                np.testing.assert_allclose(message.position, expected, rtol=0, atol=1e-9)
                assert message.name[0] == ("jaw" if topic.startswith("jaw") else "yaw")
            else:
                T_base_tip = forward(positions[:6])
                expected = T_base_tip if topic.startswith("local") else T @ T_base_tip
                np.testing.assert_allclose(matrix(message.pose), expected, rtol=0, atol=1e-9)
    described = [json.loads(message.data) for _, message in found["/carts/frame"]]
    assert [one["verdict"] for one in described] == [frame.verdict for frame in data.frames]
    masks = found["/left/corrected/mask/compressed"]
    assert [(time, stamp_of(message)) for time, message in masks] == stamps
    for view, (_, message) in zip(data.views(ExportProgress()), masks, strict=True):
        picture = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(picture, (view.link_ids >= 0) * np.uint8(255))


def test_other_sequences_have_the_time_since_the_first_image(tmp_path, tiny_sequence, shipped_psm):
    sequence = Sequence.open(tiny_sequence(frames=3))
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")
    found = messages(export(data, "rosbag2", tmp_path / "out"))
    own = found["/PSM1/corrected/measured_js"]
    assert [time for time, _ in own] == pytest.approx(np.asarray(sequence.timestamps) * ROS_TO_NS, abs=1)
    assert psm_geometry(shipped_psm) == CLASSIC


def test_times_before_zero_count_from_the_first_image(tmp_path, tiny_sequence):
    path = tiny_sequence(frames=3)
    table = path.with_name("kinematics.csv")
    table.write_text(table.read_text().replace(",0.000,", ",-12.5,").replace(",0.100,", ",-12.4,"))
    sequence = Sequence.open(path)
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")
    own = messages(export(data, "rosbag2", tmp_path / "out"))["/PSM1/corrected/measured_js"]
    assert [time for time, _ in own] == [stamp_of(message) for _, message in own] == [0, 100_000_000, 12_700_000_000]
