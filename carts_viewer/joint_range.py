"""What a joint may be set to."""

import math
from dataclasses import dataclass
from enum import StrEnum

from carts_core.model.scene import Arm


class Reach(StrEnum):
    """How far sliders reach from the measured values, as people read it."""

    NEAR = "± 5"
    FAR = "± 20"
    FULL = "Full range"

    @property
    def width(self) -> float:
        """To either side [deg] or [mm]."""
        return {Reach.NEAR: 5.0, Reach.FAR: 20.0, Reach.FULL: math.inf}[self]


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
