"""Keypoints and landmarks: points of an arm that can be identified in an image.

Keypoints are the tips of the last links and the joints behind them. Landmarks (tip, wrist, shaft edges) can be found
before any overlay is shown.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from ..arrays import Array, converted, library
from .robot import Robot
from .scene import Arm, Scene, SceneState

MAX_KEYPOINTS = 6
"""Maximum number of keypoints of an arm; the keypoints nearest to the tip are kept."""
_SAME_POINT = 5e-4
"""Distance below which joints are merged into one point [m]."""


@dataclass(frozen=True)
class Keypoint:
    """Named point that is fixed to a link."""

    arm: str
    name: str
    """Name of the point, unique in its arm."""
    link: int
    """Index into `Robot.link_names`."""
    position: tuple[float, float, float]
    """Position in the link's frame [m]."""


@dataclass(frozen=True)
class Pin:
    """A keypoint with its manually set position in an image."""

    keypoint: Keypoint
    camera: str
    pixel: tuple[float, float]
    """Column and row in the camera's full-size image, pixel centres at 0.5 [px]."""


def keypoints(arm: Arm) -> tuple[Keypoint, ...]:
    """Keypoints of an arm, from the tip backwards: the tips of its last links, then the links' joints.

    The keypoints of the shipped instrument are the tips of both jaws, the centre of the wrist's yaw joint (about which
    the jaws rotate), and the centre of the pitch joint (where the shaft ends).
    """
    robot = arm.robot
    moved_by = _moved_by(robot)
    depth = moved_by.sum(-1)
    last = [link for link in range(len(robot.link_names)) if depth[link] == depth.max()]
    points = [Keypoint(arm.name, f"{_named(robot, link)} tip", link, _tip(robot, link)) for link in last]
    for link, name in reversed(_joints(robot, depth)):
        points.append(Keypoint(arm.name, f"{name} joint", link, (0.0, 0.0, 0.0)))
    return tuple(points[:MAX_KEYPOINTS])


def project_keypoints(
    scene: Scene, state: SceneState, points: Sequence[Keypoint], camera: str
) -> Float[Array, "points 2"]:
    """Projections of points into a camera's image [px]; NaN behind the camera. A tensor, differentiable, for a state of
    tensors; an array for a state of arrays.

    Raises:
        RobotError: the camera or an arm does not exist.
    """
    view = scene.cameras.index(scene.camera(camera))
    arms = {arm.name: index for index, arm in enumerate(scene.arms)}
    links = {
        name: scene.arm(name).robot.forward_kinematics(state.joint_positions[arms[name]])
        for name in dict.fromkeys(point.arm for point in points)
    }
    pixels, of = [], library(state.intrinsics)
    fx_fy, cx_cy = state.intrinsics[view][:2], state.intrinsics[view][2:]
    for point in points:
        T_camera_base = state.T_view_world[view] @ state.T_world_base[arms[point.arm]]
        T_camera_link = T_camera_base @ links[point.arm][point.link]
        p_camera = T_camera_link[:3, :3] @ converted(np.array(point.position), T_camera_link) + T_camera_link[:3, 3]
        depth = of.where(p_camera[2:] > 0, p_camera[2:], np.nan)
        pixels.append(fx_fy * p_camera[:2] / depth + cx_cy)
    return of.stack(pixels) if pixels else state.intrinsics[:0, :2]


def _moved_by(robot: Robot) -> np.ndarray:
    """Whether each link is moved by each degree of freedom [links, dofs]."""
    rest = np.full(len(robot.joint_names), 0.01)
    before = robot.forward_kinematics(rest)
    after = robot.forward_kinematics(rest + 0.01 * np.eye(len(rest)))
    return (np.abs(after - before).max((-2, -1)) > 1e-9).T


def _joints(robot: Robot, depth: np.ndarray) -> list[tuple[int, str]]:
    """Joint centres, starting at the base: the link to which each is fixed, and its name."""
    # Positions other than 0 are used, since at 0 distinct joints may coincide.
    origins = robot.forward_kinematics(np.full(len(robot.joint_names), 0.1))[:, :3, 3]
    groups: list[list[int]] = []
    for link in sorted(np.flatnonzero(depth).tolist(), key=lambda index: depth[index]):
        together = (group for group in groups if np.linalg.norm(origins[group[0]] - origins[link]) < _SAME_POINT)
        if (group := next(together, None)) is None:
            groups.append([link])
        else:
            group.append(link)
    named = []
    for group in groups:
        # The end of the shaft is named after the wrist, and the axis of two jaws after their parent link.
        alone = [link for link in group if (depth[group] == depth[link]).sum() == 1]
        named.append((group[0], _named(robot, alone[-1] if alone else group[0])))
    return named


def _vertices(robot: Robot, link: int) -> Float[np.ndarray, "V 3"]:
    return np.concatenate([mesh.vertices for mesh in robot.meshes if mesh.link == link]).astype(np.float64)


def _tip(robot: Robot, link: int) -> tuple[float, float, float]:
    """Point of a link's meshes that is farthest from its joint, in the link's frame [m]."""
    vertices = _vertices(robot, link)
    x, y, z = vertices[np.linalg.norm(vertices, axis=-1).argmax()]
    return float(x), float(y), float(z)


def _named(robot: Robot, link: int) -> str:
    return robot.link_names[link].removesuffix("_link").replace("_", " ")


TIP = "tip"
SHAFT_EDGE = "shaft edge"
SHAFT_MIDDLE = "shaft middle"
_OUTER_SHARE = 90
"""Percentile of the distances of a shaft's vertices from its axis that is used as the radius."""
_MIN_SLENDERNESS = 5.0
"""Minimum ratio of length to width of a shaft [1]."""


class LandmarkKind(StrEnum):
    """Type of constraint from a landmark marked in the image."""

    POINT = "point"
    """The point projects to the marked position."""
    EDGE = "edge"
    """One of the two outlines of a cylinder passes through the marked position."""
    AXIS = "axis"
    """The projected axis of a cylinder passes through the marked position, at any depth."""


@dataclass(frozen=True)
class Landmark:
    """Landmark of an arm: a point, or the axis of a cylinder."""

    name: str
    kind: LandmarkKind
    hint: str
    """Description of the position, displayed in the page."""
    points: tuple[tuple[int, tuple[float, float, float]], ...]
    """Link and position in the link's frame [m]. A point is the mean of all positions; a line has two positions, the
    ends of its axis."""
    radius: float = 0.0
    """Radius of the cylinder [m]."""

    def positions(self, Ts_base_link: Float[np.ndarray, "links 4 4"]) -> Float[np.ndarray, "points 3"]:
        """Positions in the arm's base frame [m]: one for a point, two for a line."""
        found = np.stack([(Ts_base_link[link] @ (*position, 1.0))[:3] for link, position in self.points])
        return found.mean(0, keepdims=True) if self.kind is LandmarkKind.POINT else found


def landmarks(arm: Arm) -> Mapping[str, Landmark]:
    """Landmarks of an arm by name, in the recommended order of annotation.

    The landmarks of the shipped instrument are its tip, the two joints of the wrist, and the edges and axis of the
    shaft.
    """
    points = keypoints(arm)
    tips = [point for point in points if point.name.endswith(" tip")]
    joints = [point for point in points if point not in tips]
    found: dict[str, Landmark] = {}
    if tips:
        middle = tuple((point.link, point.position) for point in tips)
        hint = "The end of the instrument; with open jaws, the midpoint between their tips."
        found[TIP] = Landmark(TIP, LandmarkKind.POINT, hint, middle)
    for place, point in enumerate(joints):
        hint = "The centre of this joint."
        if place == 0:
            hint = "The centre of the joint about which the jaws rotate."
        elif point is joints[-1]:
            hint = "The centre of the joint at which the shaft ends."
        found[point.name] = Landmark(point.name, LandmarkKind.POINT, hint, ((point.link, point.position),))
    if (shaft := _shaft(arm)) is not None:
        link, start, end, radius = shaft
        line = ((link, start), (link, end))
        hint = "Any point on either outline of the shaft."
        found[SHAFT_EDGE] = Landmark(SHAFT_EDGE, LandmarkKind.EDGE, hint, line, radius)
        hint = "Any point midway between the two outlines of the shaft."
        found[SHAFT_MIDDLE] = Landmark(SHAFT_MIDDLE, LandmarkKind.AXIS, hint, line)
    return found


def _shaft(arm: Arm) -> tuple[int, tuple[float, float, float], tuple[float, float, float], float] | None:
    """Longest slender link: index, two ends of its axis in the link's frame, and radius [m]; None without a slender
    link."""
    best, longest = None, 0.0
    for link in range(len(arm.robot.link_names)):
        vertices = _vertices(arm.robot, link)
        centre = vertices.mean(0)
        _, _, directions = np.linalg.svd(vertices - centre, full_matrices=False)
        # Most vertices of a tube are at its ends, so the first principal direction is along the axis.
        along = (vertices - centre) @ directions[0]
        length = float(along.max() - along.min())
        around = np.linalg.norm((vertices - centre) - along[:, None] * directions[0], axis=-1)
        radius = float(np.percentile(around, _OUTER_SHARE))
        if length > max(longest, 2 * radius * _MIN_SLENDERNESS):
            longest = length
            ends = (centre + along.min() * directions[0], centre + along.max() * directions[0])
            start, end = (tuple(map(float, place)) for place in ends)
            best = (link, start, end, radius)
    return best  # pyright: ignore[reportReturnType]
