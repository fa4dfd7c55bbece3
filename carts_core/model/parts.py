"""Parts common to surgical instruments, and the channels of surface maps.

A surface map has `SURFACE_CHANNELS` channels: the share of each pixel that each of `PARTS` covers, in [0, 1], and the
mean unit normal of the covering surface times that coverage, in the camera's frame (x right, y down, z forward).
Background is zero. The renderer computes surface maps of a state, and the surface network predicts them from an image.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from .robot import SLENDER, Robot
from .scene import Arm

PARTS = ("shaft", "wrist", "jaws")
"""Names of the parts, in the order of their index."""

_PROBE = 0.1


@dataclass(frozen=True)
class PartClass:
    """Pixel class for a part of an arm."""

    number: int
    """Number of the class, from 1: 1 + 3 * index of the arm + index of the part."""
    arm: str
    part: str
    """One of `PARTS`."""

    @property
    def name(self) -> str:
        """Display name."""
        return f"{self.arm} {self.part}"


def part_classes(arms: Sequence[Arm]) -> tuple[PartClass, ...]:
    """Classes of all parts with a mesh, for these arms."""
    classes: list[PartClass] = []
    for index, arm in enumerate(arms):
        seen = link_parts(arm.robot)[[mesh.link for mesh in arm.robot.meshes]]
        first = 1 + len(PARTS) * index
        classes += [PartClass(first + part, arm.name, PARTS[part]) for part in np.unique(seen).tolist()]
    return tuple(classes)


def link_classes(arms: Sequence[Arm]) -> Int[np.ndarray, " links"]:
    """Class number of every link, with the links of all arms in order."""
    return np.concatenate([1 + len(PARTS) * index + link_parts(arm.robot) for index, arm in enumerate(arms)])


def link_parts(robot: Robot) -> Int[np.ndarray, " links"]:
    """Index into `PARTS` of each link with a mesh, from the number of degrees of freedom that move it.

    Links moved by all but the last two degrees of freedom belong to the wrist, links moved by more belong to the jaws
    and their bearing, and all other links belong to the shaft. For instruments without moving jaws (such as a hook),
    links that move with the shaft (the longest mesh, if slender) are not part of the wrist.
    """
    dofs = len(robot.joint_names)
    Ts = robot.forward_kinematics(np.vstack([np.zeros(dofs), _PROBE * np.eye(dofs)]))
    movers = (np.abs(Ts[1:] - Ts[:1]).max((-2, -1)) > 1e-9).sum(0)
    # All links of a robot without a wrist belong to the shaft.
    wrist = max(movers.max() - 2, _shaft_movers(robot, movers) + 1)
    return (movers >= wrist).astype(int) + (movers >= wrist + 1)


def _shaft_movers(robot: Robot, movers: Int[np.ndarray, " links"]) -> int:
    """Number of degrees of freedom that move the shaft; 0 without a shaft."""
    extents = [np.sort(np.ptp(mesh.vertices, axis=0)) for mesh in robot.meshes]
    longest = int(np.argmax([extent[-1] for extent in extents]))
    slender = extents[longest][-2] < SLENDER * extents[longest][-1]
    return int(movers[robot.meshes[longest].link]) if slender else 0


COVERAGE = slice(0, len(PARTS))
"""Channels of the coverage per part."""

NORMALS = slice(len(PARTS), len(PARTS) + 3)
"""Channels of the normal."""

SURFACE_CHANNELS = len(PARTS) + 3
