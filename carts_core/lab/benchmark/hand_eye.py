"""Benchmark of the hand-eye calibration of a seven-joint robot absent from the training data: success rate and detected
failures."""

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt8
from roma import rotmat_to_rotvec, rotvec_to_rotmat

from ...errors import CartsError
from ...files import OutputPath, write_text
from ...html import Table
from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm, Scene
from ...networks.extractor import FeatureExtractor
from ...optimization import CalibrationOptimizer, FreeParameters, MaskPredictor
from ...recording import Frame
from ...wording import counted
from .measurement import code_fingerprint, stored
from .rooms import synthetic_rooms
from .statistics import NO_VALUE, table_of
from .targets import Target, target_of

ARM = Path(__file__).with_name("seven_joint_arm.urdf")
"""URDF of the robot, which consists of cylinders, spheres and boxes."""
_COLOURS = ((0.85, 0.85, 0.83), (0.9, 0.45, 0.1))
_SIZE, _FOCAL = (640, 480), 620.0
_SAMPLES = 3
"""Rays per pixel and axis; the number is odd, so that thresholding coverage at 0.5 does not bias the mask."""

_HIDDEN = 0.25
"""Shading of surfaces seen edge-on, lit from the camera [1]."""


def looking_at(eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """T_camera_world of a camera at `eye` directed at `target`, without roll (world z is up)."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.block([[rotation, -(rotation @ eye)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def arm_views(count: int, seed: int, room: UInt8[np.ndarray, "h w 3"] | None = None) -> tuple[Scene, list[Frame]]:
    """Render views of the arm from one camera, with random poses and noise, over a 640x480 px background or grey.

    Returns:
        Scene with the true base frame and camera, and frames with masks and exact joint positions.
    """
    rng = np.random.default_rng(seed)
    robot = Robot.load(ARM)
    angle, distance = rng.uniform(0, 2 * np.pi), rng.uniform(1.6, 2.2)
    eye = np.array([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(0.5, 1.1)])
    T = looking_at(eye, np.array([0.0, 0.0, 0.5]) + rng.uniform(-0.05, 0.05, 3))
    intrinsics = (_FOCAL, _FOCAL, _SIZE[0] / 2, _SIZE[1] / 2)
    camera = Camera(name="left", width=_SIZE[0], height=_SIZE[1], intrinsics=intrinsics, T_camera_world=T)
    scene = Scene((Arm("arm", robot, np.eye(4)),), (camera,))
    behind = np.full((_SIZE[1], _SIZE[0], 3), 128, np.uint8) if room is None else room
    frames = []
    for index in range(count):
        joints = rng.uniform(-1.0, 1.0, len(robot.joint_names)) * np.array([1.5, 0.9, 1.5, 1.2, 1.5, 1.2, 1.5])
        coverage, shade = _rays(robot, joints, camera)
        picture = (1 - coverage[..., None]) * behind + 255 * shade + rng.normal(0, 2.0, (*coverage.shape, 3))
        frames.append(
            Frame(
                index=index,
                frame_id=f"{index:03d}",
                timestamp=None,
                domain="regular",
                images={"left": picture.clip(0, 255).astype(np.uint8)},
                measured={"arm": joints},
                masks={"left": coverage >= 0.5},
                truth={"arm": joints},
            )
        )
    return scene, frames


def _rays(
    robot: Robot, joints: Float[np.ndarray, " dofs"], camera: Camera
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Coverage of each pixel by the robot, and colour of the robot premultiplied by coverage."""
    Ts = robot.forward_kinematics(torch.tensor(joints)).numpy()
    parts, colours = [], []
    for mesh in robot.meshes:
        vertices = mesh.vertices @ Ts[mesh.link, :3, :3].T + Ts[mesh.link, :3, 3]
        parts.append(trimesh.Trimesh(vertices, mesh.faces, process=False))
        colours += [_COLOURS[mesh.link % len(_COLOURS)]] * len(mesh.faces)
    body = trimesh.util.concatenate(parts)
    assert isinstance(body, trimesh.Trimesh)
    if type(body.ray).__module__ != "trimesh.ray.ray_pyembree":
        raise CartsError("Rays are cast with Embree, which is not installed. Install it with: pip install embreex")
    n = _SAMPLES
    x, y = (np.arange(n * size) / n + 0.5 / n for size in (camera.width, camera.height))
    fx, fy, cx, cy = camera.intrinsics
    rays = np.stack(np.broadcast_arrays((x[None] - cx) / fx, (y[:, None] - cy) / fy, 1.0), -1).reshape(-1, 3)
    T_world_camera = np.linalg.inv(camera.T_camera_world)
    directions = rays @ T_world_camera[:3, :3].T
    hit = body.ray.intersects_first(np.broadcast_to(T_world_camera[:3, 3], directions.shape), directions)
    facing = np.abs((body.face_normals[hit] * directions).sum(1)) / np.linalg.norm(directions, axis=1)
    shade = np.array(colours)[hit] * (_HIDDEN + (1 - _HIDDEN) * facing)[:, None]
    shade[hit < 0] = 0.0
    shape = (camera.height, n, camera.width, n)
    coverage = (hit >= 0).reshape(shape).mean((1, 3))
    return coverage, shade.reshape(*shape, 3).mean((1, 3))


_VIEWS = 10
_STARTS = 10
"""Minimum number of starts per condition for a verdict on its target."""
_FREE = FreeParameters(joints=False, base_frames=True)
_CODE = ("lab/benchmark/hand_eye.py", "lab/benchmark/seven_joint_arm.urdf", "lab/benchmark/rooms.py")


@dataclass(frozen=True)
class HandEyeCondition:
    """Initial errors, with tolerances of the final base frame."""

    name: str
    angle_deg: float
    """Initial rotation error of the base frame [deg]."""
    distance: float
    """Initial translation error of the base frame [m]."""
    masks: bool
    """Whether masks are fitted instead of network predictions."""
    most_deg: float
    most_distance: float
    """Tolerance of the translation error [m]."""


CONDITIONS = (
    HandEyeCondition("masks, 15 degrees and 10 cm", 15.0, 0.1, True, 0.3, 3e-3),
    HandEyeCondition("masks, 30 degrees and 20 cm", 30.0, 0.2, True, 0.3, 3e-3),
    HandEyeCondition("network, 5 degrees and 5 cm", 5.0, 0.05, False, 0.5, 5e-3),
)


@dataclass(frozen=True)
class HandEyeRun:
    """Result for one start."""

    condition: str
    seed: int
    """Seed of the views and the start."""
    angle_deg: float
    """Rotation error of the base frame [deg]."""
    distance: float
    """Translation error of the base frame [m]."""
    verdict: str


def known_hand_eye(path: OutputPath, extractor: FeatureExtractor) -> list[HandEyeRun]:
    """Stored runs with the current code and weights."""
    return [HandEyeRun(**run) for run in stored(path, "runs", _of(extractor)) or []]


def measure_hand_eye(
    path: OutputPath, extractor: FeatureExtractor, starts: int, say: Callable[[str], None] = lambda line: None
) -> list[HandEyeRun]:
    """Run the calibrations of each condition that are not yet stored, and write each result to `path`."""
    runs = known_hand_eye(path, extractor)
    done = {(run.condition, run.seed) for run in runs}
    for condition in CONDITIONS:
        for seed in range(starts):
            if (condition.name, seed) not in done:
                say(f"hand-eye: {condition.name}, {seed + 1} of {starts}")
                runs.append(_run(condition, seed, extractor))
                write_text(path, json.dumps({"of": _of(extractor), "runs": [asdict(run) for run in runs]}, indent=1))
    return runs


def hand_eye_table(runs: list[HandEyeRun]) -> Table | None:
    """Table of success rates and verdicts by condition."""
    rows = []
    for condition in CONDITIONS:
        if found := [run for run in runs if run.condition == condition.name]:
            right = [run for run in found if _near(run, condition)]
            others = Counter(run.verdict for run in found if run not in right)
            rows.append(
                {
                    "target and start": condition.name,
                    "within tolerance": f"{len(right)} of {len(found)}",
                    "largest angle [deg]": f"{max(run.angle_deg for run in right):.2f}" if right else NO_VALUE,
                    "largest distance [mm]": f"{1e3 * max(run.distance for run in right):.1f}" if right else NO_VALUE,
                    "verdicts on the other starts": ", ".join(
                        f"{count} {verdict}" for verdict, count in others.items()
                    ),
                }
            )
    return table_of("hand_eye", rows, views=_VIEWS)


def hand_eye_targets(runs: list[HandEyeRun]) -> list[Target]:
    """Targets of hand-eye calibration."""
    targets = []
    for condition in CONDITIONS:
        own = [run for run in runs if run.condition == condition.name]
        right = [run for run in own if _near(run, condition) or (not condition.masks and run.verdict == "failed")]
        targets.append(
            target_of(
                f"hand_eye_{'masks' if condition.masks else 'network'}",
                len(right) / len(own) if own else None,
                counted(len(own), "start"),
                complete=len(own) >= _STARTS,
                condition=condition.name,
                degrees=condition.most_deg,
                mm=1e3 * condition.most_distance,
            )
        )
    return targets


def _near(run: HandEyeRun, condition: HandEyeCondition) -> bool:
    return run.angle_deg <= condition.most_deg and run.distance <= condition.most_distance


def _run(condition: HandEyeCondition, seed: int, extractor: FeatureExtractor) -> HandEyeRun:
    rooms = [room for room in synthetic_rooms() if room.half == "held-out"]
    room = rooms[seed % len(rooms)].draw(640, 480)
    rng = np.random.default_rng((seed, round(condition.angle_deg)))
    axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    off = np.eye(4)
    off[:3, :3] = rotvec_to_rotmat(torch.tensor(np.radians(condition.angle_deg) * axis)).numpy()
    off[:3, 3] = condition.distance * direction
    scene, frames = arm_views(_VIEWS, seed, room)
    (arm,) = scene.arms
    wrong = replace(scene, arms=(replace(arm, T_world_base=arm.T_world_base @ off),))
    networks = MaskPredictor() if condition.masks else extractor
    optimizer = CalibrationOptimizer(wrong, frames, networks, free=_FREE)
    for _ in optimizer:
        pass
    assert optimizer.assessment is not None
    left = np.linalg.inv(arm.T_world_base) @ optimizer.result().scene.arms[0].T_world_base
    angle = float(rotmat_to_rotvec(torch.tensor(left[:3, :3])).norm().rad2deg())
    verdict = optimizer.assessment.verdict.value
    return HandEyeRun(condition.name, seed, angle, float(np.linalg.norm(left[:3, 3])), verdict)


def _of(extractor: FeatureExtractor) -> list[str]:
    return [extractor.fingerprint, code_fingerprint(), code_fingerprint(_CODE)]
