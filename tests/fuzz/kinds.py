"""The kinds of files that CaRTS reads: a right one of each, and reading it as the commands do."""

import random
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
from videos import write_video

from carts_core.batch.manifest import read_manifest
from carts_core.cli.options import SolverOptions
from carts_core.export.kinematics import KinematicsRow, kinematics_csv, read_kinematics_csv
from carts_core.lab.training.loop import History, load_checkpoint, save_checkpoint
from carts_core.live.messages import Assembler, FrameMessage, ImageMessage, packed, receive
from carts_core.model.robot import Robot
from carts_core.networks.network import FeatureNetwork
from carts_core.networks.weights import read_weights, save_weights
from carts_core.optimization.hand_eye.files import read_points
from carts_core.recording import Sequence
from carts_core.recording.images import read_image, read_mask
from carts_core.recording.video import Video, index_video
from carts_core.settings import Architecture
from fuzz.mutations import mutated_bytes, mutated_png, mutated_safetensors, mutated_text

FRAMES = 2
_URDF = """<robot name="two_links">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="base"><visual><origin xyz="0 0 0.01" rpy="0 1.5708 0"/>
    <geometry><mesh filename="MESH" scale="0.001 0.001 0.001"/></geometry><material name="grey"/></visual></link>
  <link name="arm"><visual><geometry><cylinder radius="0.005" length="0.1"/></geometry></visual></link>
  <link name="tip"><visual><geometry><box size="0.01 0.01 0.02"/></geometry></visual></link>
  <joint name="yaw" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0.1" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5"/></joint>
  <joint name="jaw" type="revolute"><parent link="arm"/><child link="tip"/>
    <origin xyz="0 0 0.1" rpy="0 0 1.57"/><axis xyz="1 0 0"/><limit lower="-1" upper="1"/>
    <mimic joint="yaw" multiplier="2" offset="0.1"/></joint>
</robot>
"""
_SEQUENCE = """format = "carts-sequence/1"
name = "tiny"
domains = ["regular"]
[kinematics]
table = "kinematics.csv"
frame_id = "{frame:03d}"
timestamp = "time"
[light]
ambient = 0.3
position = [0.0, 0.0, -0.02]
[[arms]]
name = "PSM1"
robot = "two_links.urdf"
T_world_base = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
[arms.joints]
yaw = { column = "yaw", unit = "deg", offset = 0.01 }
[[cameras]]
name = "left"
size = [64, 48]
K = "calibration.json#left/K"
distortion = [0.01, 0.0, 0.0, 0.0]
T_camera_world = "calibration.json#left/T"
images = "images/{frame}.png"
masks = "masks/{frame}.png"
"""
_CALIBRATION = """{"left": {"K": [[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]],
 "T": [[1.0, 0.0, 0.0, 0.01], [0.0, 1.0, 0.0, 0.02], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]]}}
"""
_MANIFEST = """format = "carts-batch/1"
[[jobs]]
recordings = ["sequence.toml"]
steps = ["optimize", "export"]
"""
_KINEMATICS = "frame,time,yaw\n1,0.0,5.0\n2,0.1,6.25\n"


class NotFiniteError(Exception):
    """A value that would be written is not finite."""


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    file: str
    """The file that is changed, in the folder that `make_folder` filled."""
    mutate: Callable[[bytes, random.Random], bytes]
    read: Callable[[Path], object]
    """Reads the folder, or the file, as a command would."""


def make_folder(folder: Path) -> None:
    """Write a right file of every kind."""
    for name in ("images", "masks", "run"):
        (folder / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8), (9, 9), 3)
    mask = np.zeros((48, 64), np.uint8)
    mask[10:30, 20:50] = 255
    for frame in range(1, FRAMES + 1):
        cv2.imwrite(str(folder / f"images/{frame:03d}.png"), image)
        cv2.imwrite(str(folder / f"masks/{frame:03d}.png"), mask)
    cv2.imwrite(str(folder / "image.jpg"), image)
    cv2.imwrite(str(folder / "image.tiff"), image)
    write_video(folder / "video.mp4", [np.roll(image, shift, 1) for shift in range(FRAMES * 3)], 10)
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=10.0)
    for suffix in ("obj", "stl", "ply"):
        sphere.export(folder / f"ball.{suffix}")
        (folder / f"{suffix}.urdf").write_text(_URDF.replace("MESH", f"ball.{suffix}"))
    (folder / "two_links.urdf").write_text(_URDF.replace("MESH", "ball.stl"))
    (folder / "sequence.toml").write_text(_SEQUENCE)
    (folder / "calibration.json").write_text(_CALIBRATION)
    (folder / "kinematics.csv").write_text(_KINEMATICS)
    small = Architecture(widths=(4, 8), encoder_convolutions=(1, 1), decoder_convolutions=(1,))
    network = FeatureNetwork(small)
    save_weights(network, folder / "weights.safetensors", {"steps": 3, "loss": 0.5}, (64, 48))
    optimizer = torch.optim.AdamW(network.parameters())
    save_checkpoint(folder / "run", {"network": network}, optimizer, 3, "{}", History([{"step": 1.0}], [], 2.0))
    sequence = Sequence.open(folder / "sequence.toml")
    (folder / "corrected.csv").write_text(_corrected(sequence))
    (folder / "settings.toml").write_text(SolverOptions().printed())
    (folder / "manifest.toml").write_text(_MANIFEST)
    (folder / "points.csv").write_text("frame,camera,arm,landmark,u,v\n001,left,PSM1,tip,12.5,30\n")
    picture = (folder / "image.jpg").read_bytes()
    sent = FrameMessage(0.5, {"PSM1": {"yaw": 0.1}}, {"left": ImageMessage(picture)}, {"left": np.eye(4).tolist()})
    (folder / "message.bin").write_bytes(packed(sent))


def _corrected(sequence: Sequence) -> str:
    rows = [
        KinematicsRow(
            frame_id,
            "measured",
            {arm: positions[index] for arm, positions in sequence.measured.items()},
            {arm: 0.01 * np.ones_like(positions[index]) for arm, positions in sequence.measured.items()},
        )
        for index, frame_id in enumerate(sequence.frame_ids)
    ]
    return kinematics_csv(sequence.scene, rows)


def _check_finite(*values: object) -> None:
    if not all(np.isfinite(np.asarray(value, dtype=np.float64)).all() for value in values):
        raise NotFiniteError


def _open_robot(path: Path) -> None:
    robot = Robot.load(path)
    dofs = len(robot.joint_names)
    _check_finite(robot.forward_kinematics(torch.full((2, dofs), 0.1)).numpy())
    for mesh in robot.meshes:
        _check_finite(mesh.vertices, mesh.normals, mesh.color)
    if bool(np.isnan(robot.joint_limits).any()):
        raise NotFiniteError


def _open_sequence(path: Path) -> None:
    sequence = Sequence.open(path)
    frame = sequence.frame(0)
    _check_finite(*sequence.measured.values(), *frame.measured.values())
    state = sequence.scene.state(frame.measured)
    _check_finite(*state.joint_positions, state.T_world_base, state.T_camera_world, state.intrinsics)
    for arm, positions in zip(sequence.scene.arms, state.joint_positions, strict=True):
        _check_finite(arm.robot.forward_kinematics(positions).numpy())
    if any(word in _corrected(sequence).lower() for word in (",nan", ",inf", ",-inf")):
        raise NotFiniteError


def _open_corrected(path: Path) -> None:
    scene = Sequence.open(path.parent / "sequence.toml").scene
    for row in read_kinematics_csv(path, scene):
        _check_finite(*row.joint_positions.values())


def _open_video(path: Path) -> None:
    count = index_video(path).count
    video = Video(path, tuple(range(count)))
    for index in range(min(count, 8)):
        video.read(index)


def _open_weights(path: Path) -> None:
    weights = read_weights(path)
    _check_finite(*(value.float().numpy() for value in weights.network.state_dict().values()))


def _open_settings(path: Path) -> None:
    options = SolverOptions(settings=(str(path),))
    options.printed()
    _check_finite(*(value for value in asdict(options.chosen).values() if isinstance(value, float)))


def _open_points(path: Path) -> None:
    for point in read_points(path, Sequence.open(path.parent / "sequence.toml")):
        _check_finite(point.pixel)


def _open_message(path: Path) -> None:
    """As the server of `carts live` takes it from a socket."""
    here, there = socket.socketpair()
    with here, there:
        content = path.read_bytes()
        threading.Thread(target=_send, args=(there, content), daemon=True).start()
        message = receive(here)
    moment = message and Assembler(Sequence.open(path.parent / "sequence.toml"), ("left",)).moment(message)
    if moment:
        _check_finite(moment.frame.timestamp, *moment.frame.measured.values(), *moment.camera_poses.values())


def _send(connection: socket.socket, content: bytes) -> None:
    with suppress(OSError):
        connection.sendall(content)
        connection.shutdown(socket.SHUT_WR)


def _of_folder(name: str, read: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: read(path.parent / name)


KINDS = {
    "sequence": Kind("sequence.toml", mutated_text, _open_sequence),
    "calibration": Kind("calibration.json", mutated_text, _of_folder("sequence.toml", _open_sequence)),
    "kinematics": Kind("kinematics.csv", mutated_text, _of_folder("sequence.toml", _open_sequence)),
    "corrected": Kind("corrected.csv", mutated_text, _open_corrected),
    "png": Kind("images/001.png", mutated_png, read_image),
    "jpeg": Kind("image.jpg", mutated_bytes, read_image),
    "tiff": Kind("image.tiff", mutated_bytes, read_image),
    "mask": Kind("masks/001.png", mutated_png, read_mask),
    "video": Kind("video.mp4", mutated_bytes, _open_video),
    "urdf": Kind("two_links.urdf", mutated_text, _open_robot),
    "obj": Kind("ball.obj", mutated_text, _of_folder("obj.urdf", _open_robot)),
    "stl": Kind("ball.stl", mutated_bytes, _of_folder("stl.urdf", _open_robot)),
    "ply": Kind("ball.ply", mutated_bytes, _of_folder("ply.urdf", _open_robot)),
    "weights": Kind("weights.safetensors", mutated_safetensors, _open_weights),
    "settings": Kind("settings.toml", mutated_text, _open_settings),
    "manifest": Kind("manifest.toml", mutated_text, read_manifest),
    "points": Kind("points.csv", mutated_text, _open_points),
    "message": Kind("message.bin", mutated_bytes, _open_message),
    "checkpoint": Kind("run/checkpoint.safetensors", mutated_safetensors, lambda path: load_checkpoint(path.parent)),
}
