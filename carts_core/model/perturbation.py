"""Perturbation of joint positions."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from .scene import Scene


def perturb(
    scene: Scene,
    joint_positions: Mapping[str, Float[np.ndarray, " dofs"]],
    degrees: float,
    seed: int | tuple[int, ...],
    joints: Mapping[str, tuple[str, ...]] | None = None,
) -> dict[str, Float[np.ndarray, " dofs"]]:
    """Move every joint by `degrees`, each with a random sign (the paper's kinematics errors).

    Prismatic joints move by the same number of millimetres. Positions are clamped to the joint limits;
    a position that is already beyond a limit does not move farther out.

    Args:
        joint_positions: arm name -> joint positions [rad, m].
        joints: arm name -> joints to move; every joint of every arm by default.
    """
    generator = np.random.default_rng(seed)
    moved = {}
    for arm in scene.arms:
        robot = arm.robot
        step = np.array([np.deg2rad(degrees) if kind == "revolute" else degrees / 1e3 for kind in robot.joint_types])
        # Signs are drawn for all joints, so that they do not depend on the selection.
        step = step * generator.choice((-1.0, 1.0), len(step))
        if joints is not None:
            step = step * [name in joints.get(arm.name, ()) for name in robot.joint_names]
        start = np.asarray(joint_positions[arm.name], dtype=np.float64)
        low, high = robot.joint_limits.T
        moved[arm.name] = np.clip(start + step, np.minimum(low, start), np.maximum(high, start))
    return moved
