"""Placement and smooth motion of the arms in view and above the tissue, and simulated measurement errors.

Tissue, light, smoke and blood are designed for an endoscope at a distance of 0.1 m. Distant cameras, for other robots,
are rendered at this scale with a miniature of the arm. Poses are written at full scale, since images do not determine
the scale.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
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
from ...settings import EndoscopeConfig, MeasurementError, SynthesisConfig
from .path_tracer import NEAR
from .scene import CENTRE, WORK_POINTS, Tissue, rotation_between


def measure(
    truth: Float[np.ndarray, "frames dofs"],
    times: Float[np.ndarray, " frames"],
    error: MeasurementError,
    rng: np.random.Generator,
) -> Float[np.ndarray, "frames dofs"]:
    """Measured joint positions T_m = T + bias + drift(t) + noise(t), [rad] or [m] per joint as in `truth`.

    Raises:
        SettingsError: the number of values in the error is neither the number of joints nor one more (jaws, which some
            tools lack).
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
"""Distance from the first wrist axis to the point between the jaw tips [m]: 9.1 + 10.2 mm of the classic PSM."""
_ATTEMPTS = 400
_LIMIT_MARGIN = 0.05
"""Margin at both ends of each joint's range, as a share of the range [1]."""
_NUDGE = 1e-6
_NEWTON_STEPS = 12
_CONVERGED = 1e-9
"""Newton step [rad, m] after which the next step is below floating-point precision, because of quadratic
convergence."""
_BORDER = 0.08
"""Minimum distance of the tips from the image border, as a share of the image size [1]."""
_NEAREST, _FARTHEST = 0.55, 1.35
"""Bounds of the depth of the tips, relative to that of the centre of the scene [1]."""
_MARGIN = 0.1
"""Margin around the image within which collisions are checked, as a share of the image size [1]."""
_INWARDS = (np.array([0.55, 0.45, -0.70]), np.array([-0.60, 0.35, -0.72]))
"""Direction of the jaws in the world, with joints at mid-range, per arm: towards the other arm and down."""


Motion = TypeVar("Motion")


class Rejected(Exception):
    """A random motion cannot be used; the message is the reason."""


def plan_motion(
    arms: Sequence[Arm], tissues: Sequence[Tissue], camera: Camera, config: SynthesisConfig
) -> tuple[Float[np.ndarray, "frames dofs"], ...]:
    """True joint positions of each arm [rad, m].

    Random splines are drawn until a motion is within the joint limits, in view, and free of collisions.

    Raises:
        SettingsError: no motion that satisfies the settings was found.
    """
    bodies = tuple(surface_points(arm.robot, config.rng("surface points")) for arm in arms)

    def draw(rng: np.random.Generator) -> tuple[Float[np.ndarray, "frames dofs"], ...]:
        joints = tuple(_draw(arm, number, camera, config, rng) for number, arm in enumerate(arms))
        seen = [clouds(arm, positions, body) for arm, positions, body in zip(arms, joints, bodies, strict=True)]
        check_clearance(seen, tissues, camera, config.motion.clearance)
        return joints

    return random_motion(draw, config)


def random_motion(draw: Callable[[np.random.Generator], Motion], config: SynthesisConfig) -> Motion:
    """Draw random motions until a motion is not rejected.

    `draw` returns a motion or raises `Rejected`.

    Raises:
        SettingsError: all attempts are rejected.
    """
    reasons = Counter[str]()
    for attempt in range(_ATTEMPTS):
        try:
            return draw(config.rng("motion", attempt))
        except Rejected as rejected:
            reasons[str(rejected)] += 1
    why = ", ".join(f"{reason} ({count})" for reason, count in reasons.most_common())
    raise SettingsError(
        f"none of {_ATTEMPTS} random motions satisfies the settings: {why}. "
        "Reduce motion.reach or motion.wrist_range, or use another seed."
    )


def sample_times(config: SynthesisConfig) -> Float[np.ndarray, " frames"]:
    """Time of each frame [s]."""
    return np.arange(config.motion.frames) / config.motion.frame_rate


def _spline(config: SynthesisConfig, rng: np.random.Generator, spread: np.ndarray) -> Float[np.ndarray, "frames n"]:
    """Random splines about 0, with knots within `spread`."""
    times = sample_times(config)
    controls = max(4, int(np.ceil(times[-1] / config.motion.control_interval)) + 1)
    knots = np.linspace(0.0, max(times[-1], 1e-3), controls)
    return CubicSpline(knots, rng.uniform(-1.0, 1.0, (controls, len(spread))) * spread, bc_type="clamped")(times)


def reach_tip(
    arm: Arm, tip_link: str, targets_world: Float[np.ndarray, "n 3"], joints: Float[np.ndarray, "n dofs"]
) -> Float[np.ndarray, "n dofs"]:
    """Inverse kinematics: yaw, pitch and insertion with the tip at each target; other joints are fixed.

    Newton's method on the forward kinematics. The three joints are the spherical coordinates of the shaft about the
    remote centre, so the method converges in a few steps from a nearby start.
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
    """Random motion of one arm, within its joint limits and in view."""
    motion = config.motion
    targets = np.asarray(WORK_POINTS[number]) + _spline(config, rng, np.asarray(motion.reach))
    check_view(targets, camera)
    joints = np.zeros((motion.frames, len(arm.robot.joint_names)))
    joints[:, 2] = 0.14
    joints[:, 3:6] = _wrist_middle(arm, number, config, rng) + _spline(config, rng, np.full(3, motion.wrist_range))
    low, high = motion.jaw_range
    joints[:, 6:] = np.clip((low + high) / 2 + _spline(config, rng, np.array([0.75 * (high - low)])), low, high)
    joints = reach_tip(arm, config.tip_link, targets, joints)
    lowest, highest = arm.robot.joint_limits[:6].T
    margin = _LIMIT_MARGIN * (highest - lowest)
    if (joints[:, :6] < lowest + margin).any() or (joints[:, :6] > highest - margin).any():
        raise Rejected("a joint is too close to its limit")
    return joints


def _wrist_middle(arm: Arm, number: int, config: SynthesisConfig, rng: np.random.Generator) -> Float[np.ndarray, " 3"]:
    """Roll, wrist pitch and wrist yaw [rad] with the jaws pointing inwards and down: the best of many random
    samples."""
    joints = np.zeros((600, len(arm.robot.joint_names)))
    joints[:, 2] = 0.14
    joints[:, 3] = rng.uniform(-1.8, 1.8, len(joints))
    joints[:, 4:6] = rng.uniform(-0.75, 0.75, (len(joints), 2))
    straight = joints.copy()
    straight[:, 4:6] = 0.0
    tips, straight_tips = (_tips(arm.robot, config.tip_link, torch.from_numpy(q)).numpy() for q in (joints, straight))
    # With a straight wrist, the tip is on the shaft axis, which passes through the remote centre at the base origin.
    shaft = straight_tips / np.linalg.norm(straight_tips, axis=-1, keepdims=True)
    jaws = (tips - (straight_tips - WRIST_LENGTH * shaft)) @ arm.T_world_base[:3, :3].T
    jaws /= np.linalg.norm(jaws, axis=-1, keepdims=True)
    wanted = _INWARDS[number] + rng.normal(0.0, 0.25, 3)
    return joints[np.argmax(jaws @ wanted), 3:6]


def check_clearance(
    clouds: Sequence[list[np.ndarray]], tissues: Sequence[Tissue], camera: Camera, clearance: float
) -> None:
    """Raise `Rejected` if visible instruments are too close to each other or to the tissue in a frame."""
    for frame in zip(*clouds, strict=True):
        seen = [points[_seen(points, camera, _MARGIN)] for points in frame]
        for points in seen:
            for tissue in tissues:
                if (points[:, 2] - tissue.height(points[:, 0], points[:, 1])).min() < clearance:
                    raise Rejected("an instrument touches the tissue")
        if len(seen) > 1 and KDTree(seen[0]).query(seen[1])[0].min() < clearance:
            raise Rejected("the instruments touch")


def check_view(tips_world: np.ndarray, camera: Camera) -> None:
    """Raise `Rejected` if tips leave the image, come close to its border, or are not at a working distance."""
    if not _seen(tips_world, camera, -_BORDER).all():
        raise Rejected("a tip leaves the image")
    *depths, centre = np.vstack([tips_world, CENTRE]) @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    if not (_NEAREST * centre < min(depths) and max(depths) < _FARTHEST * centre):
        raise Rejected("a tip is too close to the camera or too far from it")


def _seen(points_world: Float[np.ndarray, "n 3"], camera: Camera, margin: float) -> Bool[np.ndarray, " n"]:
    """Whether each point is in the image, enlarged by `margin` as a share of the image size."""
    T, (fx, fy, cx, cy) = camera.T_camera_world, camera.intrinsics
    x, y, z = (points_world @ T[:3, :3].T + T[:3, 3]).T
    z_or_near = np.maximum(z, NEAR)
    u, v = (fx * x / z_or_near + cx) / camera.width, (fy * y / z_or_near + cy) / camera.height
    return (np.abs(u - 0.5) < 0.5 + margin) & (np.abs(v - 0.5) < 0.5 + margin) & (z > NEAR)


def surface_points(robot: Robot, rng: np.random.Generator, spacing: float = 0.0018) -> list[np.ndarray]:
    """Points sampled on the surface of each link, in the link frame [m]."""
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
    """Surface points of an arm in the world [m], per frame."""
    Ts = arm.T_world_base @ arm.robot.forward_kinematics(torch.from_numpy(positions)).numpy()
    return [np.concatenate([p @ T[:3, :3].T + T[:3, 3] for p, T in zip(body, frame, strict=True)]) for frame in Ts]


ARM_NAME = "arm"

INSTRUMENT_DISTANCE = 0.16
"""Camera distance up to which the world is rendered at its true scale, since the tissue fills the image [m]."""

_USUAL = 0.1
"""Distance of the camera in the reduced world [m]."""

_FREE = 1.5
"""Maximum motion of a joint without limits, to either side [rad, m]."""

_ERROR = {"revolute": (0.02, 0.004, 0.0005), "prismatic": (0.002, 0.0004, 0.00005)}
"""Default bias, drift and noise of a joint [rad, m], used if the settings are the defaults."""

_TURN = 0.6
"""Random range (three standard deviations) of the direction from which the arm enters the image [rad]."""


def enlargement(config: EndoscopeConfig) -> float:
    """Scale of the world, relative to the rendered world [1]."""
    return config.distance / _USUAL if config.distance > INSTRUMENT_DISTANCE else 1.0


def measurement_error(robot: Robot, error: MeasurementError) -> MeasurementError:
    """The given measurement error, or typical values for the robot's joint types if the settings are the defaults."""
    if error != MeasurementError():
        return error
    values = [_ERROR[kind] for kind in robot.joint_types]
    bias, drift, noise = zip(*values, strict=True)
    return replace(error, bias=bias, drift=drift, noise=noise)


def plan_arm(
    robot: Robot, tissues: Sequence[Tissue], camera: Camera, config: SynthesisConfig, scale: float
) -> tuple[Arm, Float[np.ndarray, "frames dofs"]]:
    """Plan the pose of an arm and its true joint positions [rad, m], with the tip near the image centre.

    Args:
        robot: robot of the arm.
        tissues: tissues that the arm must not touch, in the reduced world.
        camera: camera in the reduced world.
        config: motion and seed.
        scale: scale of the world, relative to the reduced world [1].

    Raises:
        SettingsError: no motion that satisfies the settings was found.
        RobotError: `config.tip_link` names a link that the robot lacks.
    """
    body = surface_points(robot, config.rng("surface points"), spacing=0.0018 * scale)
    tip_link = robot.link_names[-1] if config.tip_link == SynthesisConfig.tip_link else config.tip_link

    def draw(rng: np.random.Generator) -> tuple[Arm, np.ndarray]:
        joints = _draw_arm(robot, config, rng)
        tips = _tips(robot, tip_link, torch.from_numpy(joints)).numpy()
        # In the middle of the motion, the tip is at the work point.
        tip = _tips(robot, tip_link, torch.from_numpy(joints[len(joints) // 2])).numpy()
        if np.linalg.norm(tip) < 1e-9:
            raise SettingsError(
                f"the tip {tip_link!r} of {robot.urdf} coincides with its base. Give another --tip-link."
            )
        arm = _placed(robot, tip, camera, rng, scale)
        check_view((tips @ arm.T_world_base[:3, :3].T + arm.T_world_base[:3, 3]) / scale, camera)
        seen = [points / scale for points in clouds(arm, joints, body)]
        check_clearance([seen], tissues, camera, config.motion.clearance)
        return arm, joints

    return random_motion(draw, config)


def _draw_arm(robot: Robot, config: SynthesisConfig, rng: np.random.Generator) -> Float[np.ndarray, "frames dofs"]:
    """Random motion about a random configuration, within the joint limits."""
    low, high = robot.joint_limits.T
    low, high = np.where(np.isfinite(low), low, -_FREE), np.where(np.isfinite(high), high, _FREE)
    reach = np.minimum(config.motion.wrist_range, 0.25 * (high - low))
    middle = rng.uniform(low + 1.2 * reach, high - 1.2 * reach)
    return np.clip(middle + _spline(config, rng, np.ones(len(low))) * reach, low, high)


def _placed(robot: Robot, tip: Float[np.ndarray, "3"], camera: Camera, rng: np.random.Generator, scale: float) -> Arm:
    """Arm whose shaft enters from beside the camera and whose `tip` (in the base frame [m]) is at the work point."""
    right, down, forward = camera.T_camera_world[:3, :3]
    side = rng.choice((-1.0, 1.0))
    direction = -side * right - 0.5 * down + 0.35 * forward + rng.normal(0.0, _TURN / 3, 3)
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = rotation = rotation_between(tip, direction)
    T_world_base[:3, 3] = scale * np.asarray(WORK_POINTS[0]) * (0.0, 0.0, 1.0) - rotation @ tip
    return Arm(ARM_NAME, robot, T_world_base)
