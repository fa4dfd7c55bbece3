"""A table-top arm with meshes of its own, and a LeRobot data set of it: images, motor positions, masks, calibration."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from lerobot_sets import write_parquet
from videos import write_video

from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.rendering import Renderer

JOINTS = {
    "shoulder_pan": ("0 0 1", (0.0, 0.0, 0.06), 1.9),
    "shoulder_lift": ("0 1 0", (0.0, 0.0, 0.05), 1.7),
    "elbow_flex": ("0 1 0", (0.12, 0.0, 0.0), 1.7),
    "wrist_flex": ("0 1 0", (0.11, 0.0, 0.0), 1.6),
    "wrist_roll": ("1 0 0", (0.06, 0.0, 0.0), 2.7),
    "gripper": ("0 0 1", (0.02, 0.02, 0.0), 1.0),
}
"""Joint -> axis, origin in the previous link [m], and limit [rad]; names as of a motor bus."""
_LINKS = ((0.0, 0.0), (0.0, 0.0), (0.12, 0.0), (0.11, 0.0), (0.06, 0.0), (0.05, -0.02), (0.06, 0.02))
_WIDTHS = (0.09, 0.06, 0.045, 0.036, 0.03, 0.024, 0.014)
SIZE = 320, 240


def _mesh(length: float, width: float, height: float) -> str:
    """A tapered block along x from 0 to `length` in OBJ; upright and `height` high if it has no length [m]."""
    corners = []
    for end, (at, half) in enumerate(((-0.4 * width, width / 2), (max(length, 0.4 * width), 0.35 * width))):
        for y, z in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            low, high = (-half, half) if length else (0.0, height)
            corners.append((at, y * half * (0.8 if end else 1.0), high if z > 0 else low))
    faces = (1, 2, 3), (1, 3, 4), (5, 7, 6), (5, 8, 7), (1, 5, 6), (1, 6, 2)
    faces += (2, 6, 7), (2, 7, 3), (3, 7, 8), (3, 8, 4), (4, 8, 5), (4, 5, 1)
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in corners]
    return "\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in faces)]) + "\n"


def write_table_robot(folder: Path) -> Path:
    """The URDF of the arm, with an OBJ file for each link."""
    folder.mkdir(parents=True, exist_ok=True)
    links, joints = [], []
    for number, ((length, _), width) in enumerate(zip(_LINKS, _WIDTHS, strict=True)):
        (folder / f"link_{number}.obj").write_text(_mesh(length, width, 0.06))
        geometry = f'<geometry><mesh filename="link_{number}.obj"/></geometry>'
        links.append(f'<link name="link_{number}"><visual>{geometry}</visual></link>')
    for number, (name, (axis, origin, limit)) in enumerate(JOINTS.items()):
        joints.append(
            f'<joint name="{name}" type="revolute"><parent link="link_{number}"/><child link="link_{number + 1}"/>'
            f'<origin xyz="{" ".join(map(str, origin))}"/><axis xyz="{axis}"/>'
            f'<limit lower="{-limit if name != "gripper" else 0.0}" upper="{limit}" effort="1" velocity="1"/></joint>'
        )
    path = folder / "arm.urdf"
    path.write_text(f'<?xml version="1.0"?><robot name="arm">{"".join(links)}{"".join(joints)}</robot>')
    return path


@dataclass(frozen=True)
class TableSet:
    """A data set and its ground truth."""

    folder: Path
    urdf: Path
    calibration: Path
    masks: Path
    T_camera_base: np.ndarray


def write_table_set(folder: Path, frames: int = 10, seed: int = 1) -> TableSet:
    """A LeRobot data set (v2.1) with motor positions of -100 to 100, a camera calibration, and a mask of each frame."""
    urdf = write_table_robot(folder / "robot")
    robot, rng = Robot.load(urdf), np.random.default_rng(seed)
    forward = np.array([-0.55, 0.35, -0.32])
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(z, [0.0, 0.0, 1.0]))
    R = np.stack([x, np.cross(z, x), z])
    T_camera_base = np.eye(4)
    T_camera_base[:3, :3], T_camera_base[:3, 3] = R, R @ -(np.array([0.08, 0.0, 0.12]) - 0.75 * z)
    camera = Camera("front", *SIZE, (330.0, 330.0, SIZE[0] / 2, SIZE[1] / 2), np.eye(4))
    scene = Scene((Arm("arm", robot, T_camera_base),), (camera,))
    renderer = Renderer(scene)
    limits = np.array([limit for _, _, limit in JOINTS.values()])
    percent = rng.uniform(-55, 55, (frames, len(JOINTS)))
    percent[:, 1] = rng.uniform(-70, -20, frames)
    percent[:, 5] = rng.uniform(10, 90, frames)
    joints = percent / 100 * limits
    (folder / "masks").mkdir()
    images = []
    background = cv2.resize(rng.uniform(60, 200, (12, 16, 3)).astype(np.float32), SIZE, interpolation=cv2.INTER_CUBIC)
    for number, row in enumerate(joints):
        rendering = renderer(scene.state({"arm": row}))
        cover = rendering.silhouette[0].detach().numpy()[..., None]
        arm = 255 * rendering.image[0].permute(1, 2, 0).detach().numpy()
        images.append((cover * arm + (1 - cover) * background).clip(0, 255).astype(np.uint8))
        cv2.imwrite(str(folder / "masks" / f"{number:06d}.png"), 255 * (cover[..., 0] > 0.5).astype(np.uint8))
    names = [f"{name}.pos" for name in JOINTS]
    features = {
        "observation.state": {"dtype": "float32", "shape": [len(names)], "names": names},
        "observation.images.front": {
            "dtype": "video",
            "shape": [SIZE[1], SIZE[0], 3],
            "names": ["height", "width", "channel"],
        },
    }
    info = {"codebase_version": "v2.1", "fps": 30, "total_episodes": 1, "chunks_size": 1000, "features": features}
    (folder / "set/meta").mkdir(parents=True)
    (folder / "set/meta/info.json").write_text(json.dumps(info))
    table = {"observation.state": percent.tolist(), "episode_index": [0] * frames, "frame_index": list(range(frames))}
    write_parquet(folder / "set/data/chunk-000/episode_000000.parquet", table)
    write_video(folder / "set/videos/chunk-000/observation.images.front/episode_000000.mp4", images, 30)
    fx, fy, cx, cy = camera.intrinsics
    K = {"rows": 3, "cols": 3, "data": [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1]}
    plain = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_name": "front", "camera_matrix": K}
    plain |= {"distortion_model": "plumb_bob", "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5}}
    (folder / "front.yaml").write_text(yaml.safe_dump(plain))
    return TableSet(folder / "set", urdf, folder / "front.yaml", folder / "masks", T_camera_base)
