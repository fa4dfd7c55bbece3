"""Places of an arm that a person finds in an image before any overlay is there: tip, wrist, and the shaft's edges."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Float

from .keypoints import keypoints
from .scene import Arm

TIP = "tip"
SHAFT_EDGE = "shaft edge"
SHAFT_MIDDLE = "shaft middle"
_OUTER_SHARE = 90
"""Percentile of the distances of a shaft's vertices from its axis that is taken for its radius."""
_LEAST_SLENDERNESS = 5.0
"""A link that is longer than its width by this factor is a shaft."""


class LandmarkKind(StrEnum):
    """What a place in the image says about the arm."""

    POINT = "point"
    """The point is seen exactly there."""
    EDGE = "edge"
    """One of the two outlines of a cylinder passes there, whichever."""
    AXIS = "axis"
    """The axis of a cylinder is seen there, at any depth."""


@dataclass(frozen=True)
class Landmark:
    """A place that a person can find: a point, or a straight line with a thickness."""

    name: str
    kind: LandmarkKind
    hint: str
    """Where to find it, for people."""
    points: tuple[tuple[int, tuple[float, float, float]], ...]
    """Link and position in its frame [m]. The mean of all for a point, two ends of the axis otherwise."""
    radius: float = 0.0
    """Of the cylinder [m]."""

    def positions(self, Ts_base_link: Float[np.ndarray, "links 4 4"]) -> Float[np.ndarray, "points 3"]:
        """Where its points are in the arm's base frame [m]: one for a point, two for a line."""
        found = np.stack([(Ts_base_link[link] @ (*position, 1.0))[:3] for link, position in self.points])
        return found.mean(0, keepdims=True) if self.kind is LandmarkKind.POINT else found


def landmarks(arm: Arm) -> Mapping[str, Landmark]:
    """The places of an arm by their names, in the order in which they are best looked for.

    The shipped instrument has its tip, the two joints of the wrist, and edges and middle of the shaft.
    """
    points = keypoints(arm)
    tips = [point for point in points if point.name.endswith(" tip")]
    joints = [point for point in points if point not in tips]
    found: dict[str, Landmark] = {}
    if tips:
        middle = tuple((point.link, point.position) for point in tips)
        hint = "The end of the instrument; between the two tips where the jaws are open."
        found[TIP] = Landmark(TIP, LandmarkKind.POINT, hint, middle)
    for place, point in enumerate(joints):
        hint = "The centre of this joint."
        if place == 0:
            hint = "The centre of the joint about which the jaws turn."
        elif point is joints[-1]:
            hint = "The centre of the joint at which the shaft ends."
        found[point.name] = Landmark(point.name, LandmarkKind.POINT, hint, ((point.link, point.position),))
    if (shaft := _shaft(arm)) is not None:
        link, start, end, radius = shaft
        line = ((link, start), (link, end))
        hint = "Any place on the outline of the shaft, on either side."
        found[SHAFT_EDGE] = Landmark(SHAFT_EDGE, LandmarkKind.EDGE, hint, line, radius)
        hint = "Any place in the middle between the two outlines of the shaft."
        found[SHAFT_MIDDLE] = Landmark(SHAFT_MIDDLE, LandmarkKind.AXIS, hint, line)
    return found


def link_transforms(
    arm: Arm, joint_positions: Float[np.ndarray, "frames dofs"]
) -> Float[np.ndarray, "frames links 4 4"]:
    """Where the links are in the arm's base frame, in double precision."""
    return arm.robot.forward_kinematics(torch.as_tensor(np.asarray(joint_positions, np.float64))).numpy()


def _shaft(arm: Arm) -> tuple[int, tuple[float, float, float], tuple[float, float, float], float] | None:
    """Link, two ends of the axis in the link's frame and radius [m] of the longest slender link; None without one."""
    best, longest = None, 0.0
    for link in range(len(arm.robot.link_names)):
        vertices = np.concatenate([mesh.vertices for mesh in arm.robot.meshes if mesh.link == link]).astype(np.float64)
        centre = vertices.mean(0)
        _, _, directions = np.linalg.svd(vertices - centre, full_matrices=False)
        # A tube's vertices are at its ends mainly, so that the first direction is the tube's own.
        along = (vertices - centre) @ directions[0]
        length = float(along.max() - along.min())
        around = np.linalg.norm((vertices - centre) - along[:, None] * directions[0], axis=-1)
        radius = float(np.percentile(around, _OUTER_SHARE))
        if length > max(longest, 2 * radius * _LEAST_SLENDERNESS):
            longest = length
            ends = (centre + along.min() * directions[0], centre + along.max() * directions[0])
            start, end = (tuple(map(float, place)) for place in ends)
            best = (link, start, end, radius)
    return best  # pyright: ignore[reportReturnType]
