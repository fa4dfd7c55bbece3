"""One arm of any URDF before the camera, in place of two instruments.

Everything around it (tissue, light, smoke, blood) is made for an endoscope a decimetre away. A camera further off sees
a world that is enlarged as a whole, which no picture can tell from a small one: it is traced in the small world, where
the arm is a miniature, and written in metres.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from ...errors import SettingsError
from ...model.camera import Camera
from ...model.robot import Robot
from ...model.scene import Arm
from ...settings import EndoscopeConfig, MeasurementError, SynthesisConfig
from .motion import Rejected, check_clearance, clouds, in_view, random_motion, sample_times, surface_points
from .scene import WORK_POINTS, Tissue, rotation_between

ARM_NAME = "arm"

_ENDOSCOPE = 0.3
"""Cameras up to this distance look at the world as it is [m]."""

_USUAL = 0.1
"""Distance for which the small world is made [m]."""

_FREE = 1.5
"""Range in which a joint without limits moves, to either side [rad, m]."""

_ERROR = {"revolute": (0.02, 0.004, 0.0005), "prismatic": (0.002, 0.0004, 0.00005)}
"""Bias, drift and noise of a joint [rad, m], where the settings are those of an instrument."""

_TURN = 0.6
"""How far, at random, the arm comes from elsewhere than its instrument would [rad]."""


def enlargement(config: EndoscopeConfig) -> float:
    """How many times larger the world is than the one that is traced [1]."""
    return config.distance / _USUAL if config.distance > _ENDOSCOPE else 1.0


def small_world(config: SynthesisConfig) -> SynthesisConfig:
    """The settings with the camera as it stands in the world that is traced."""
    endoscope, scale = config.endoscope, enlargement(config.endoscope)
    small = replace(endoscope, distance=endoscope.distance / scale, baseline=endoscope.baseline / scale)
    return replace(config, endoscope=small)


def enlarged(camera: Camera, scale: float) -> Camera:
    """A camera of the small world in the large one."""
    T_camera_world = camera.T_camera_world.copy()
    T_camera_world[:3, 3] *= scale
    return replace(camera, T_camera_world=T_camera_world)


def measurement_error(robot: Robot, error: MeasurementError) -> MeasurementError:
    """The settings, or where they are an instrument's, typical values for the robot's kinds of joints."""
    if error != MeasurementError():
        return error
    values = [_ERROR[kind] for kind in robot.joint_types]
    bias, drift, noise = zip(*values, strict=True)
    return replace(error, bias=bias, drift=drift, noise=noise)


def plan_arm(
    robot: Robot, tissues: Sequence[Tissue], camera: Camera, config: SynthesisConfig, scale: float
) -> tuple[Arm, Float[np.ndarray, "frames dofs"]]:
    """Where the arm stands, and its true joint positions [rad, m]; its tip is at work in the middle of the picture.

    Args:
        robot: of the arm.
        tissues: that it must not touch, in the small world.
        camera: in the small world.
        config: motion and seed.
        scale: of the large world.

    Raises:
        SettingsError: no motion within the settings was found.
        RobotError: `config.tip_link` names a link that the robot lacks.
    """
    body = surface_points(robot, config.rng("surface points"), spacing=0.0018 * scale)

    def draw(rng: np.random.Generator) -> tuple[Arm, np.ndarray]:
        joints = _draw(robot, config, rng)
        arm = _placed(robot, _tip_link(robot, config), joints, camera, rng, scale)
        tips = robot.link_transform(torch.from_numpy(joints), _tip_link(robot, config))[:, :3, 3].numpy()
        if not in_view((tips @ arm.T_world_base[:3, :3].T + arm.T_world_base[:3, 3]) / scale, camera):
            raise Rejected("the tip leaves the picture")
        seen = [points / scale for points in clouds(arm, joints, body)]
        check_clearance([seen], tissues, camera, config.motion.clearance)
        return arm, joints

    return random_motion(draw, config)


def _tip_link(robot: Robot, config: SynthesisConfig) -> str:
    return robot.link_names[-1] if config.tip_link == SynthesisConfig.tip_link else config.tip_link


def _draw(robot: Robot, config: SynthesisConfig, rng: np.random.Generator) -> Float[np.ndarray, "frames dofs"]:
    """A random motion about a random pose, within the joints' limits."""
    times, motion = sample_times(config), config.motion
    controls = max(4, int(np.ceil(times[-1] / motion.control_interval)) + 1)
    knots = np.linspace(0.0, max(times[-1], 1e-3), controls)
    low, high = robot.joint_limits.numpy().T
    low, high = np.where(np.isfinite(low), low, -_FREE), np.where(np.isfinite(high), high, _FREE)
    reach = np.minimum(motion.wrist_range, 0.25 * (high - low))
    middle = rng.uniform(low + 1.2 * reach, high - 1.2 * reach)
    waves = CubicSpline(knots, rng.uniform(-1.0, 1.0, (controls, len(low))), bc_type="clamped")(times)
    return np.clip(middle + waves * reach, low, high)


def _placed(
    robot: Robot,
    tip_link: str,
    joints: Float[np.ndarray, "frames dofs"],
    camera: Camera,
    rng: np.random.Generator,
    scale: float,
) -> Arm:
    """The arm with its tip, in the middle of the motion, at the work point; it comes in from beside the camera."""
    tip = robot.link_transform(torch.from_numpy(joints[len(joints) // 2]), tip_link)[:3, 3].numpy()
    if np.linalg.norm(tip) < 1e-9:
        raise SettingsError(f"the tip {tip_link!r} of {robot.urdf} lies in its base. Name another --tip-link.")
    right, down, forward = camera.T_camera_world[:3, :3]
    side = rng.choice((-1.0, 1.0))
    direction = -side * right - 0.5 * down + 0.35 * forward + rng.normal(0.0, _TURN / 3, 3)
    rotation = rotation_between(tip, direction)
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = rotation
    T_world_base[:3, 3] = scale * np.asarray(WORK_POINTS[0]) * (0.0, 0.0, 1.0) - rotation @ tip
    return Arm(ARM_NAME, robot, T_world_base)


def check_instrument_distance(config: EndoscopeConfig) -> None:
    """Raise where a camera is too far off for instruments, whose scene cannot be enlarged.

    Raises:
        SettingsError: it is.
    """
    if enlargement(config) != 1.0:
        raise SettingsError(
            f"EndoscopeConfig.distance is {config.distance} m, but the robot is a surgical instrument. Give at most "
            f"{_ENDOSCOPE} m for these; other robots may be further away."
        )
