"""Smooth motion of two instruments that stay in view, apart and above the tissue, and its erroneous measurement."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

from ...errors import SettingsError
from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm
from ...settings import MeasurementError, SynthesisConfig
from .path_tracer import NEAR
from .scene import WORK_POINTS, Tissue


def measure(
    truth: Float[np.ndarray, "frames dofs"],
    times: Float[np.ndarray, " frames"],
    error: MeasurementError,
    rng: np.random.Generator,
) -> Float[np.ndarray, "frames dofs"]:
    """Measured joint positions T_m = T + bias + drift(t) + noise(t), [rad] or [m] per joint as in `truth`.

    Raises:
        SettingsError: the error does not have one value per joint, or one more: that of jaws, which some tools lack.
    """
    dofs = truth.shape[-1]
    if len(error.bias) not in (dofs, dofs + 1):
        raise SettingsError(f"MeasurementError has {len(error.bias)} values per kind, but the robot has {dofs} joints.")
    bias = np.asarray(error.bias[:dofs]) * rng.choice([-1.0, 1.0], dofs) * rng.uniform(0.6, 1.2, dofs)
    periods = error.drift_period * rng.uniform(0.6, 1.6, (2, dofs))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, dofs))
    waves = np.sin(2.0 * np.pi * times[:, None, None] / periods + phases).mean(axis=1)
    noise = rng.standard_normal(truth.shape) * np.asarray(error.noise[:dofs])
    return truth + bias + np.asarray(error.drift[:dofs]) * waves + noise


WRIST_LENGTH = 0.0193
"""From the wrist's first axis to the point between the jaws' tips [m]: 9.1 + 10.2 mm of the classic PSM."""
_ATTEMPTS = 400
_LIMIT_MARGIN = 0.05
"""Part of each joint's range kept free at both ends."""
_NUDGE = 1e-6
_NEWTON_STEPS = 12
_CONVERGED = 1e-9
"""Step [rad, m] after which the next one, a square of it, would be below the precision of the numbers."""
_BORDER = 0.08
"""The tips keep away from the picture's border by this part of its size."""
_MARGIN = 0.1
"""Collisions are looked for in the picture and in a margin around it, a part of its size."""
_INWARDS = (np.array([0.55, 0.45, -0.70]), np.array([-0.60, 0.35, -0.72]))
"""Where the jaws point in the middle of their range, in the world: to the other arm and down."""


Motion = TypeVar("Motion")


class Rejected(Exception):
    """Why a random motion cannot be used."""


def plan_motion(
    arms: Sequence[Arm], tissues: Sequence[Tissue], camera: Camera, config: SynthesisConfig
) -> tuple[Float[np.ndarray, "frames dofs"], ...]:
    """True joint positions of each arm [rad, m].

    Random splines are drawn until one keeps inside the joint limits, in view, and free of collisions.

    Raises:
        SettingsError: no motion within the settings was found.
    """
    bodies = tuple(surface_points(arm.robot, config.rng("surface points")) for arm in arms)

    def draw(rng: np.random.Generator) -> tuple[Float[np.ndarray, "frames dofs"], ...]:
        joints = tuple(_draw(arm, number, camera, config, rng) for number, arm in enumerate(arms))
        seen = [clouds(arm, positions, body) for arm, positions, body in zip(arms, joints, bodies, strict=True)]
        check_clearance(seen, tissues, camera, config.motion.clearance)
        return joints

    return random_motion(draw, config)


def random_motion(draw: Callable[[np.random.Generator], Motion], config: SynthesisConfig) -> Motion:
    """The first of many random motions that is not rejected.

    Args:
        draw: makes one, or raises `Rejected`.
        config: with the seed.

    Raises:
        SettingsError: all are.
    """
    reasons: dict[str, int] = {}
    for attempt in range(_ATTEMPTS):
        try:
            return draw(config.rng("motion", attempt))
        except Rejected as rejected:
            reasons[str(rejected)] = reasons.get(str(rejected), 0) + 1
    why = ", ".join(f"{reason} ({count})" for reason, count in sorted(reasons.items(), key=lambda item: -item[1]))
    raise SettingsError(
        f"none of {_ATTEMPTS} random motions fits the settings: {why}. "
        "Make motion.reach or motion.wrist_range smaller, or take another seed."
    )


def sample_times(config: SynthesisConfig) -> Float[np.ndarray, " frames"]:
    """Time of each frame [s]."""
    return np.arange(config.motion.frames) / config.motion.frame_rate


def reach_tip(
    arm: Arm, tip_link: str, targets_world: Float[np.ndarray, "n 3"], joints: Float[np.ndarray, "n dofs"]
) -> Float[np.ndarray, "n dofs"]:
    """Inverse kinematics: yaw, pitch and insertion that bring the tip to each target, the other joints as given.

    Newton's method on the forward kinematics; the three joints are the shaft's spherical coordinates about the
    remote centre, so it converges in a few steps from anywhere near.
    """
    solution = torch.from_numpy(joints.copy())
    goals = torch.from_numpy((targets_world - arm.T_world_base[:3, 3]) @ arm.T_world_base[:3, :3])
    nudges = torch.zeros(4, 1, joints.shape[-1], dtype=torch.float64)
    nudges[range(1, 4), 0, range(3)] = _NUDGE
    for _ in range(_NEWTON_STEPS):
        tips = _tips(arm.robot, tip_link, solution + nudges)
        jacobian = ((tips[1:] - tips[0]) / _NUDGE).movedim(0, -1)
        step = torch.linalg.solve(jacobian, (goals - tips[0])[..., None])[..., 0]
        solution[:, :3] += torch.clamp(step, -0.3, 0.3)
        if step.abs().max() < _CONVERGED:
            break
    return solution.numpy()


def _tips(robot: Robot, tip_link: str, joints: torch.Tensor) -> torch.Tensor:
    return robot.link_transform(joints, tip_link)[..., :3, 3]


def _draw(
    arm: Arm, number: int, camera: Camera, config: SynthesisConfig, rng: np.random.Generator
) -> Float[np.ndarray, "frames dofs"]:
    """One random motion of one arm, within its limits and in view."""
    motion = config.motion
    times = sample_times(config)
    controls = max(4, int(np.ceil(times[-1] / motion.control_interval)) + 1)
    knots = np.linspace(0.0, max(times[-1], 1e-3), controls)

    def spline(spread: np.ndarray) -> np.ndarray:
        return CubicSpline(knots, rng.uniform(-1.0, 1.0, (controls, len(spread))) * spread, bc_type="clamped")(times)

    targets = np.asarray(WORK_POINTS[number]) + spline(np.asarray(motion.reach))
    if not in_view(targets, camera):
        raise Rejected("a tip leaves the picture")
    joints = np.zeros((len(times), len(arm.robot.joint_names)))
    joints[:, 2] = 0.14
    joints[:, 3:6] = _wrist_middle(arm, number, config, rng) + spline(np.full(3, motion.wrist_range))
    low, high = motion.jaw_range
    joints[:, 6:] = np.clip((low + high) / 2 + spline(np.array([0.75 * (high - low)])), low, high)
    joints = reach_tip(arm, config.tip_link, targets, joints)
    lowest, highest = arm.robot.joint_limits.numpy()[:6].T
    margin = _LIMIT_MARGIN * (highest - lowest)
    if (joints[:, :6] < lowest + margin).any() or (joints[:, :6] > highest - margin).any():
        raise Rejected("a joint comes too near to its limit")
    return joints


def _wrist_middle(arm: Arm, number: int, config: SynthesisConfig, rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
    """Roll, wrist pitch and wrist yaw for which the jaws point inwards and down: the best of many random ones."""
    joints = np.zeros((600, len(arm.robot.joint_names)))
    joints[:, 2] = 0.14
    joints[:, 3] = rng.uniform(-1.8, 1.8, len(joints))
    joints[:, 4:6] = rng.uniform(-0.75, 0.75, (len(joints), 2))
    straight = joints.copy()
    straight[:, 4:6] = 0.0
    tips, straight_tips = (_tips(arm.robot, config.tip_link, torch.from_numpy(q)).numpy() for q in (joints, straight))
    # With a straight wrist the tip lies on the shaft's axis, which passes the remote centre at the base's origin.
    shaft = straight_tips / np.linalg.norm(straight_tips, axis=-1, keepdims=True)
    jaws = (tips - (straight_tips - WRIST_LENGTH * shaft)) @ arm.T_world_base[:3, :3].T
    jaws /= np.linalg.norm(jaws, axis=-1, keepdims=True)
    wanted = _INWARDS[number] + rng.normal(0.0, 0.25, 3)
    return joints[np.argmax(jaws @ wanted), 3:6]


def check_clearance(
    clouds: Sequence[list[np.ndarray]], tissues: Sequence[Tissue], camera: Camera, clearance: float
) -> None:
    """Raise when, in some frame and in view, the instruments come too near to each other or to the tissue."""
    for frame in zip(*clouds, strict=True):
        seen = [points[_seen(points, camera, _MARGIN)] for points in frame]
        for points in seen:
            for tissue in tissues:
                if (points[:, 2] - tissue.height(points[:, 0], points[:, 1])).min() < clearance:
                    raise Rejected("an instrument touches the tissue")
        if len(seen) > 1 and KDTree(seen[0]).query(seen[1])[0].min() < clearance:
            raise Rejected("the instruments touch")


def in_view(tips_world: np.ndarray, camera: Camera) -> bool:
    """Whether tips stay in the picture, away from its border, and at a working distance."""
    depth = tips_world @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    return bool((_seen(tips_world, camera, -_BORDER) & (depth > 0.055) & (depth < 0.135)).all())


def _seen(points_world: Float[np.ndarray, "n 3"], camera: Camera, margin: float) -> Bool[np.ndarray, " n"]:
    """Which points are in the picture, or in a margin around it that is given as a part of its size."""
    T, (fx, fy, cx, cy) = camera.T_camera_world, camera.intrinsics
    x, y, z = (points_world @ T[:3, :3].T + T[:3, 3]).T
    z_or_near = np.maximum(z, NEAR)
    u, v = (fx * x / z_or_near + cx) / camera.width, (fy * y / z_or_near + cy) / camera.height
    return (np.abs(u - 0.5) < 0.5 + margin) & (np.abs(v - 0.5) < 0.5 + margin) & (z > NEAR)


def surface_points(robot: Robot, rng: np.random.Generator, spacing: float = 0.0018) -> list[np.ndarray]:
    """Points spread over the surface of each link, in its frame [m]."""
    points: list[list[np.ndarray]] = [[] for _ in robot.link_names]
    for mesh in robot.meshes:
        corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1) / 2
        count = int(np.ceil(area.sum() / spacing**2)) + 20
        chosen = corners[rng.choice(len(corners), count, p=area / area.sum())]
        weights = rng.dirichlet((1.0, 1.0, 1.0), count)
        points[mesh.link].append(np.einsum("nk,nkd->nd", weights, chosen))
    return [np.concatenate(part) if part else np.zeros((0, 3)) for part in points]


def clouds(arm: Arm, positions: np.ndarray, body: list[np.ndarray]) -> list[np.ndarray]:
    """Surface points of an arm in the world, per frame."""
    Ts = arm.T_world_base @ arm.robot.forward_kinematics(torch.from_numpy(positions)).numpy()
    return [np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(body, frame, strict=True)]) for frame in Ts]
