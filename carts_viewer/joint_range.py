"""What a joint may be set to."""

import math
from dataclasses import dataclass

from carts_core.model.scene import Arm


@dataclass(frozen=True)
class JointRange:
    """What a joint may be set to."""

    arm: str
    joint: str
    revolute: bool
    lower: float
    """[rad] or [m]; a joint without limits may turn once round either way."""
    upper: float


def joint_range(arm: Arm, joint: int) -> JointRange:
    """Of the joint with this index."""
    lower, upper = (float(value) for value in arm.robot.joint_limits[joint])
    revolute = arm.robot.joint_types[joint] == "revolute"
    # A joint without limits gets a slider with ends all the same: once round, or a metre, either way.
    room = math.pi if revolute else 1.0
    return JointRange(
        arm.name,
        arm.robot.joint_names[joint],
        revolute,
        lower if math.isfinite(lower) else -room,
        upper if math.isfinite(upper) else room,
    )
