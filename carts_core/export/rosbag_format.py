"""ROS 2 bag (MCAP) with corrected joint states, tip poses and masks, written with `rosbags`.

The bag contains only the results. For sequences from a bag, it has the record times and header stamps of the images, so
both bags can be played or opened together.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..files import OutputPath, output_stream
from ..files.reading import BAG, open_regular
from ..model.camera import T_DVRK_OPENCV
from ..model.psm_kinematics import JOINT_NAMES, PsmGeometry, forward
from ..model.robot import Robot
from ..model.scene import Arm
from ..package_imports import require_package
from ..recording.image_sources import BagImages, Cropped
from ..recording.importing.logs import CANDIDATES
from .dataset import Dataset, ExportFrame, ExportProgress, View
from .encodings import mask_png
from .video import frame_rate

_NAME = "corrected"
_VERSION = 8
"""Version of the bag's metadata, supported by ROS 2 Humble and later."""
_SAME_LINK = 1e-5
"""Tolerance for the distance between a link's origin and the tip of the closed-form PSM kinematics [m]."""
_NANOSECONDS = 10**9


@dataclass(frozen=True)
class Stamp:
    """Times of a message."""

    record: int
    """Record time [ns]."""
    header: int
    """Time of the data [ns]."""


def write_rosbag2(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write `corrected.mcap` and `metadata.yaml`.

    Raises:
        SequenceError: the sequence is from a bag, and an image message is missing.
        CartsError: the package `rosbags` is missing.
    """
    require_package("rosbags", "import")
    with TemporaryDirectory() as temporary:
        bag = Path(temporary) / _NAME
        _write(dataset, bag, progress)
        for file in sorted(bag.iterdir()):
            with open_regular(file, BAG) as source, output_stream(folder / file.name) as stream:
                copyfileobj(source, stream)


def _write(dataset: Dataset, bag: Path, progress: ExportProgress) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: PLC0415 - an extra

    messages = _Messages()
    arms = {arm.name: (name, psm_geometry(arm.robot)) for arm, name in _named(dataset.scene.arms)}
    cameras = {camera.name: name for camera, name in _named(dataset.scene.cameras)}
    last = None
    with Writer(bag, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}

        def write(topic: str, stamp: Stamp, message: Any) -> None:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=messages.store)
            writer.write(connections[topic], stamp.record, messages.store.serialize_cdr(message, kind))

        for view in dataset.views(progress):
            stamp = _stamp(dataset, view)
            if view.frame is not last:
                last = view.frame
                write("/carts/frame", stamp, messages.text(_description(view.frame)))
                for arm in dataset.scene.arms:
                    name, geometry = arms[arm.name]
                    for topic, message in _arm_messages(messages, stamp, dataset, view, arm, geometry):
                        write(f"/{name}/corrected/{topic}", stamp, message)
            png = mask_png(dataset.recorded_mask(view))
            topic = f"/{cameras[view.camera.name]}/corrected/mask/compressed"
            write(topic, stamp, messages.image(stamp, view.camera.name, png))


def _named(items: tuple[Any, ...]) -> list[tuple[Any, str]]:
    """Arms or cameras with unique names for topics, which have letters, digits and `_`."""
    found: dict[str, Any] = {}
    for item in items:
        name = re.sub(r"[^A-Za-z0-9_]", "_", item.name)
        name = name if name[:1].isalpha() else f"x{name}"
        while name in found:
            name += "_"
        found[name] = item
    return [(item, name) for name, item in found.items()]


def _stamp(dataset: Dataset, view: View) -> Stamp:
    """Times of a view: those of the message with its image, else the time since the first image, by timestamps or by
    index and frame rate."""
    sequence, index = dataset.sequence, view.frame.index
    source = sequence.image_source(view.camera.name, dataset.domain)
    source = source.source if isinstance(source, Cropped) else source
    if isinstance(source, BagImages):
        return Stamp(*source.times_of(index))
    times = sequence.timestamps
    seconds = index / frame_rate(dataset) if times is None else times[index] - times.min()
    time = round(float(seconds) * _NANOSECONDS)
    return Stamp(time, time)


def _description(frame: ExportFrame) -> str:
    content = {"frame": frame.frame_id, "source": frame.source, "verdict": frame.verdict}
    return json.dumps(content, ensure_ascii=False)


def _arm_messages(
    messages: "_Messages", stamp: Stamp, dataset: Dataset, view: View, arm: Arm, geometry: PsmGeometry | None
) -> list[tuple[str, Any]]:
    """Topics, relative to that of the arm, and messages with its results in a frame."""
    names = arm.robot.joint_names
    positions = view.frame.joint_positions[arm.name]
    std = (view.frame.joint_std or {}).get(arm.name, np.full(len(names), np.nan))
    groups = {"measured_js": [name for name in names if name != "jaw" or geometry is None]}
    if geometry is not None and "jaw" in names:
        groups["jaw/measured_js"] = ["jaw"]
    found = []
    for topic, group in groups.items():
        columns = [names.index(name) for name in group]
        found.append((topic, messages.joints(stamp, group, positions[columns])))
        found.append((topic.replace("measured", "std"), messages.joints(stamp, group, std[columns])))
    if geometry is not None:
        T_base_tip = forward(positions[[names.index(name) for name in JOINT_NAMES]], geometry)
        found.append(("local/measured_cp", messages.pose(stamp, f"{arm.name}_base", T_base_tip)))
        camera = dataset.scene.cameras[0]
        mount = dataset.sequence.mounts(view.frame.index).get(camera.name, np.eye(4))
        T_camera_tip = camera.T_camera_world @ mount @ arm.T_world_base @ T_base_tip
        found.append(("measured_cp", messages.pose(stamp, camera.name, T_DVRK_OPENCV @ T_camera_tip)))
    return found


def psm_geometry(robot: Robot) -> PsmGeometry | None:
    """Lengths of a PSM, found by comparing its URDF with the closed-form kinematics; None for other robots."""
    names = robot.joint_names
    if not set(JOINT_NAMES) <= set(names):
        return None
    columns = [names.index(name) for name in JOINT_NAMES]
    joints = np.zeros((3, len(names)))
    joints[:, columns] = [[0.1, 0.2, 0.12, 0.3, 0.4, 0.5], [-0.3, 0.1, 0.15, -0.5, 0.2, -0.4], [0, 0, 0.1, 0, 0, 0]]
    origins = robot.forward_kinematics(joints)[:, :, :3, 3]
    best, distance = None, _SAME_LINK
    for geometry in CANDIDATES.values():
        tips = forward(joints[:, columns], geometry)[:, None, :3, 3]
        nearest = float(np.linalg.norm(origins - tips, axis=-1).max(0).min())
        if nearest < distance:
            best, distance = geometry, nearest
    return best


class _Messages:
    """Factory of ROS messages."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - an extra

        self.store = get_typestore(Stores.ROS2_HUMBLE)

    def _make(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def _header(self, stamp: Stamp, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp.header, _NANOSECONDS)
        time = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame_id)

    def text(self, text: str) -> Any:
        """std_msgs/String."""
        return self._make("std_msgs/msg/String", data=text)

    def joints(self, stamp: Stamp, names: list[str], positions: np.ndarray) -> Any:
        """sensor_msgs/JointState [rad, m]."""
        none = np.empty(0)
        return self._make(
            "sensor_msgs/msg/JointState",
            header=self._header(stamp, ""),
            name=names,
            position=np.asarray(positions, np.float64),
            velocity=none,
            effort=none,
        )

    def pose(self, stamp: Stamp, frame_id: str, T: np.ndarray) -> Any:
        """geometry_msgs/PoseStamped [m]."""
        x, y, z = T[:3, 3].tolist()
        qx, qy, qz, qw = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )
        return self._make("geometry_msgs/msg/PoseStamped", header=self._header(stamp, frame_id), pose=pose)

    def image(self, stamp: Stamp, frame_id: str, png: bytes) -> Any:
        """sensor_msgs/CompressedImage of a PNG file."""
        return self._make(
            "sensor_msgs/msg/CompressedImage",
            header=self._header(stamp, frame_id),
            format="png",
            data=np.frombuffer(png, np.uint8),
        )
