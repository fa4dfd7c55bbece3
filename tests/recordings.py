"""Recordings of the shipped robot in foreign formats, each written by its official writer if available."""

import atexit
import hashlib
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from carts_core.errors import CartsError
from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.model.ecm_kinematics import forward as ecm
from carts_core.model.psm_kinematics import JOINT_NAMES, forward
from carts_core.recording.importing.importer import import_recording

SIZE = (96, 72)
START = 1_700_000_000_000_000_000
"""[ns]"""
T_CAMERA_BASE = np.eye(4)
T_CAMERA_BASE[:3, :3] = Rotation.from_rotvec([2.6, 0.4, 0.2]).as_matrix()
T_CAMERA_BASE[:3, 3] = 0.02, -0.03, 0.02
K = np.array([[110.0, 0, 47.5], [0, 110.0, 35.5], [0, 0, 1]])
BASELINE = 0.005


def joints_at(time: np.ndarray | float) -> np.ndarray:
    """Six joints [rad, m] at times [s]."""
    phase = np.asarray(time, np.float64)[..., None] * [0.9, 1.1, 0.7, 0.5, 1.7, 1.3]
    return np.array([0.1, 0.05, 0.12, 0.5, 0.1, -0.2]) + np.array([0.2, 0.15, 0.03, 0.6, 0.5, 0.4]) * np.sin(phase)


def jaw_at(time: np.ndarray | float) -> np.ndarray:
    return 0.3 + 0.2 * np.sin(np.asarray(time, np.float64))


def endoscope_at(time: np.ndarray | float) -> np.ndarray:
    """Four joints of the ECM [rad, m] at times [s]."""
    phase = np.asarray(time, np.float64)[..., None] * [1.0, 1.3, 0.8, 1.1]
    return np.array([0.1, -0.2, 0.11, 0.3]) + np.array([0.05, 0.04, 0.01, 0.1]) * np.sin(phase)


def image(number: int, camera: str = "left") -> np.ndarray:
    """RGB image that identifies its frame and camera."""
    picture = np.full((SIZE[1], SIZE[0], 3), 60 if camera == "left" else 120, np.uint8)
    picture[:, : 8 * (number % 10) + 8, 0] = 200
    return picture


def ros_yaml(
    R: np.ndarray | None = None,
    P: np.ndarray | None = None,
    *,
    size: tuple[int, int] = SIZE,
    K: np.ndarray = K,
    D: Sequence[float] = (-0.1, 0.02, 0, 0, 0),
    name: str = "left",
    more: str = "",
) -> str:
    """A calibration as ROS writes it, with a rectification on request."""

    def matrix(values: np.ndarray) -> str:
        rows, columns = values.shape
        return f"{{rows: {rows}, cols: {columns}, data: {values.reshape(-1).tolist()}}}"

    return (
        f"image_width: {size[0]}\nimage_height: {size[1]}\ncamera_name: {name}\ncamera_matrix: {matrix(K)}\n"
        + ("" if "model" in more else "distortion_model: plumb_bob\n")
        + f"distortion_coefficients: {matrix(np.array([D]))}\n"
        + ("" if R is None else f"rectification_matrix: {matrix(R)}\n")
        + ("" if P is None else f"projection_matrix: {matrix(P)}\n")
        + more
    )


def write_images(folder: Path, count: int, name: str = "{:04d}.png", camera: str = "left") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        assert cv2.imwrite(str(folder / name.format(number)), image(number, camera)[..., ::-1])


def pose_of(T: np.ndarray) -> list[float]:
    """x y z and a quaternion x y z w."""
    return [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]


@dataclass(frozen=True)
class BagKind:
    """Options of a bag."""

    ros: int = 2
    storage: str = "sqlite3"
    generation: str = "2.2"
    """Version of the dVRK: 1.x, 2.0 or 2.2."""
    compressed: bool = True
    joints: bool = True
    local: bool = True
    cameras: tuple[str, ...] = ("left", "right")
    arms: tuple[str, ...] = ("PSM1",)
    frames: int = 6
    endoscope: str = ""
    """Topic below /ECM with the pose of the endoscope; none by default."""
    names: tuple[str, ...] = ()
    """Joint names of the arms, in this order; by default all "outer_yaw", in the order of the PSM."""
    tool_point: float = 0.0
    """Distance of the point of measured_cp from the tip, along the tool [m]."""
    info: Callable[[dict[str, Any]], None] | None = None
    """Function that changes the values of every camera_info."""


def write_bag(path: Path, kind: BagKind = BagKind()) -> Path:
    """A bag of half a second: 12 images/s a camera, 100 rows/s an arm."""
    store = get_typestore(Stores.ROS1_NOETIC if kind.ros == 1 else Stores.ROS2_HUMBLE)
    if kind.ros == 1:
        writer: Any = Writer1(path)
        encode = store.serialize_ros1
    else:
        plugin = StoragePlugin.MCAP if kind.storage == "mcap" else StoragePlugin.SQLITE3
        writer, encode = Writer2(path, version=9, storage_plugin=plugin), store.serialize_cdr
    messages = sorted(_messages(store, kind), key=lambda entry: entry[0])
    with writer:
        connections: dict[str, Any] = {}
        for time, topic, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connections[topic], time, encode(message, message.__msgtype__))
    return path


def along_the_tool(distance: float) -> np.ndarray:
    """T_tip_point [m] of a more distal point."""
    T = np.eye(4)
    T[2, 3] = distance
    return T


def _messages(store: Any, kind: BagKind):
    def make(kind_of_message: str, **values: Any) -> Any:
        return store.types[kind_of_message](**values)

    def header(time: int, frame: str) -> Any:
        stamp = make("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)
        extra = {"seq": 0} if kind.ros == 1 else {}
        return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    old = kind.generation == "1.x"
    for arm in kind.arms:
        prefix = f"/dvrk/{arm}" if old else f"/{arm}"
        for row in range(-5, 8 * kind.frames + 5):
            time = START + row * 10_000_000
            q = joints_at(row / 100)
            rows = {}
            if kind.joints:
                rows["state_joint_current" if old else "measured_js"] = q
            rows["state_jaw_current" if old else "jaw/measured_js"] = jaw_at(row / 100)[None]
            for topic, values in rows.items():
                names, positions = ["outer_yaw"] * len(values), np.asarray(values, np.float64)
                if kind.names and len(values) > 1:
                    names = list(kind.names)
                    bare = [name.removeprefix("outer_") for name in names]
                    if sorted(bare) == sorted(JOINT_NAMES):
                        positions = positions[[JOINT_NAMES.index(name) for name in bare]]
                message = make(
                    "sensor_msgs/msg/JointState",
                    header=header(time, ""),
                    name=names,
                    position=positions,
                    velocity=np.empty(0),
                    effort=np.empty(0),
                )
                yield time + 900_000, f"{prefix}/{topic}", message
            T = forward(q) @ along_the_tool(kind.tool_point)
            poses = {"measured_cp": T_DVRK_OPENCV @ T_CAMERA_BASE @ T}
            if kind.local:
                poses["local/measured_cp"] = T
            if old:
                poses = {"position_cartesian_current": poses["measured_cp"]}
            for topic, pose in poses.items():
                yield time + 950_000, f"{prefix}/{topic}", _pose(make, header(time + 300_000, "ECM"), pose, kind)
        if kind.generation == "2.2":
            yield START, f"{prefix}/tool_type", make("std_msgs/msg/String", data="LARGE_NEEDLE_DRIVER:400006[1]")
    yield from _endoscope_messages(make, header, kind)
    for camera in kind.cameras:
        for frame in range(kind.frames):
            time = START + frame * 80_000_000 + (1_000_000 if camera == "right" else 0)
            yield from _image_messages(make, header(time, camera), time + 5_000_000, frame, camera, kind)


def _endoscope_messages(make: Any, header: Any, kind: BagKind):
    for row in range(-5, 8 * kind.frames + 5) if kind.endoscope else ():
        time, q = START + row * 10_000_000, endoscope_at(row / 100)
        if kind.endoscope.endswith("_js"):
            values = {"name": ["yaw"] * 4, "position": q, "velocity": np.empty(0), "effort": np.empty(0)}
            message = make("sensor_msgs/msg/JointState", header=header(time, ""), **values)
        else:
            message = _pose(make, header(time, "world"), ecm(q), kind)
        yield time + 800_000, f"/ECM/{kind.endoscope}", message


def _pose(make: Any, header: Any, T: np.ndarray, kind: BagKind) -> Any:
    x, y, z, *q = pose_of(T)
    rotation = make("geometry_msgs/msg/Quaternion", x=q[0], y=q[1], z=q[2], w=q[3])
    if kind.generation == "2.0":
        translation = make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
        transform = make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
        return make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id="", transform=transform)
    position = make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    pose = make("geometry_msgs/msg/Pose", position=position, orientation=rotation)
    return make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)


def _image_messages(make: Any, header: Any, time: int, frame: int, camera: str, kind: BagKind):
    picture = image(frame, camera)
    if kind.compressed:
        data = cv2.imencode(".png", picture[..., ::-1])[1].reshape(-1)
        message = make("sensor_msgs/msg/CompressedImage", header=header, format="png", data=data)
        yield time, f"/stereo/{camera}/image_raw/compressed", message
    else:
        message = make(
            "sensor_msgs/msg/Image",
            header=header,
            height=SIZE[1],
            width=SIZE[0],
            encoding="bgr8",
            is_bigendian=0,
            step=3 * SIZE[0],
            data=np.ascontiguousarray(picture[..., ::-1]).reshape(-1),
        )
        yield time, f"/stereo/{camera}/image_raw", message
    P = np.column_stack([K, [-K[0, 0] * BASELINE if camera == "right" else 0.0, 0, 0]])
    values = {
        "height": SIZE[1],
        "width": SIZE[0],
        "distortion_model": "plumb_bob",
        "K": K.reshape(-1),
        "D": np.zeros(5),
        "R": np.eye(3).reshape(-1),
        "P": P.reshape(-1),
    }
    if kind.info is not None:
        kind.info(values)
    if kind.ros == 2:
        values = {key.lower() if len(key) == 1 else key: value for key, value in values.items()}
    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    info = make("sensor_msgs/msg/CameraInfo", header=header, binning_x=0, binning_y=0, roi=roi, **values)
    yield time, f"/stereo/{camera}/camera_info", info


def assert_refused(path: Path, message: str) -> None:
    """Check that the import of the only entry of a folder raises a matching error and writes nothing."""
    with pytest.raises(CartsError, match=message):
        import_recording(path, path.parent / "out")
    assert list(path.parent.iterdir()) == [path]


def write(name: str, content: str | bytes) -> Callable[[Path], object]:
    """Function that replaces a file of a recording."""
    data = content if isinstance(content, bytes) else content.encode()
    return lambda folder: (folder / name).write_bytes(data)


def cut(name: str, length: int) -> Callable[[Path], object]:
    """Function that truncates a file of a recording."""
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:length])


def remove(name: str) -> Callable[[Path], object]:
    """Function that removes a file of a recording."""
    return lambda folder: (folder / name).unlink()


def save(name: str, values: np.ndarray) -> Callable[[Path], object]:
    """Function that replaces an array of a recording."""
    return lambda folder: np.save(folder / name, values)


@cache
def _made(make: Callable[[Path], Path]) -> tuple[Path, Path]:
    folder = Path(tempfile.mkdtemp(prefix="carts-made-"))
    atexit.register(shutil.rmtree, folder)
    return folder / "source", make(folder / "source")


def copied(make: Callable[[Path], Path], folder: Path) -> Path:
    """Copy of a recording that is generated once; returns the result of `make`."""
    source, path = _made(make)
    shutil.copytree(source, folder)
    return folder / path.relative_to(source)


def with_hidden_twins(folder: Path, pattern: str) -> Path:
    """The folder with a file of macOS, such as `._1.json`, beside each file of a pattern."""
    for file in [*folder.rglob(pattern)]:
        (file.parent / f"._{file.name}").write_bytes(b"\x00\x05\x16\x07")
    return folder


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a folder."""
    files = [file for file in folder.rglob("*") if file.is_file()]
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
