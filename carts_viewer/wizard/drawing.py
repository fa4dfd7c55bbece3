"""Drawing of an instrument that shows where its landmarks are, made from the meshes of its robot."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from carts_core.model.keypoints import LandmarkKind, landmarks
from carts_core.model.scene import Arm

WIDTH, HEIGHT = 640, 256
"""Size of the drawing [px]."""
_BEND = 0.6
"""Position of every joint, as a share of its range [1]; the joints of a wrist are thus slightly bent."""
_OBLIQUE = np.radians(30.0)
"""Rotation of the view about the shaft [rad], so that both jaws are visible."""
_MARGIN = 0.2
"""Margin around the landmarks, as a share of width and height [1]."""
_TOLERANCE = 0.7
"""Maximum distance of the outline from the silhouette [px]."""


@dataclass(frozen=True)
class Part:
    """Silhouette of a link."""

    link: int
    path: str
    """Data of an SVG path."""


@dataclass(frozen=True)
class Drawing:
    """Silhouettes, from back to front, and landmarks."""

    parts: tuple[Part, ...]
    places: dict[str, tuple[float, float]]
    """Landmark -> position [px]."""
    links: dict[str, frozenset[int]]
    """Landmark -> links to which it belongs."""


def drawing_of(arm: Arm) -> Drawing | None:
    """Drawing of an arm's instrument; None if the arm has no landmark points."""
    robot, known = arm.robot, landmarks(arm)
    points = {name: mark for name, mark in known.items() if mark.kind is LandmarkKind.POINT}
    if not points:
        return None
    low, high = robot.joint_limits.T
    low, high = np.clip(low, -np.pi, np.pi), np.clip(high, -np.pi, np.pi)
    Ts = arm.robot.forward_kinematics((low + _BEND * (high - low))[None])[0]
    centres = np.stack([mark.positions(Ts)[0] for mark in points.values()])
    shaft = next((mark for mark in known.values() if mark.kind is not LandmarkKind.POINT), None)
    behind = centres[-1] if shaft is None else shaft.positions(Ts).mean(0)
    axes = _view(centres, behind)
    scale, middle = _frame(centres @ axes[:2].T)

    def placed(position: np.ndarray) -> Float[np.ndarray, "... 2"]:
        return (position @ axes[:2].T - middle) * scale + (WIDTH / 2, HEIGHT / 2)

    parts = []
    for link in range(len(robot.link_names)):
        meshes = [mesh for mesh in robot.meshes if mesh.link == link]
        triangles = [mesh.vertices.astype(np.float64)[mesh.faces] for mesh in meshes]
        if not triangles:
            continue
        corners = np.concatenate(triangles) @ Ts[link, :3, :3].T + Ts[link, :3, 3]
        if path := _silhouette(placed(corners)):
            near = np.percentile((corners @ axes[2]).ravel(), 10)
            parts.append((near, Part(link, path)))
    places = {name: tuple(placed(mark.positions(Ts)[0]).round(1).tolist()) for name, mark in points.items()}
    for name, mark in known.items():
        if mark.kind is not LandmarkKind.POINT:
            ends = placed(mark.positions(Ts))
            start = ends[np.linalg.norm(ends - placed(centres[-1]), axis=1).argmin()]
            beside = (-mark.radius * scale) if mark.kind is LandmarkKind.EDGE else 0.0
            places[name] = (round(float(start[0]) / 2, 1), round(float(start[1]) + beside, 1))
    links = {name: frozenset(link for link, _ in mark.points) for name, mark in known.items()}
    return Drawing(tuple(part for _, part in sorted(parts, key=lambda each: -each[0])), places, links)


def _view(centres: Float[np.ndarray, "points 3"], behind: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Axes right, down and forward of the view, in the base frame: the shaft is horizontal, its tip on the right."""
    right = centres[-1] - behind
    right = right / max(float(np.linalg.norm(right)), 1e-12) if np.linalg.norm(right) > 1e-9 else np.eye(3)[0]
    beside = (centres - centres[-1]) - np.outer((centres - centres[-1]) @ right, right)
    _, spread, directions = np.linalg.svd(beside)
    down = directions[0] if spread[0] > 1e-6 else np.eye(3)[np.abs(right).argmin()]
    down = down - (down @ right) * right
    down /= np.linalg.norm(down)
    forward = np.cross(right, down)
    down = np.cos(_OBLIQUE) * down + np.sin(_OBLIQUE) * forward
    return np.stack([right, down, np.cross(right, down)])


def _frame(points: Float[np.ndarray, "points 2"]) -> tuple[float, np.ndarray]:
    """Scale [px/m] and centre [m] of the drawing, such that it contains the points."""
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 1e-3)
    scale = min((1 - 2 * _MARGIN) * WIDTH / size[0] * 0.75, (1 - 2 * _MARGIN) * HEIGHT / size[1])
    # More of the shaft than of the space beyond the tip is shown.
    return float(scale), (low + high) / 2 - np.array([0.1 * WIDTH / scale, 0.0])


def _silhouette(triangles: Float[np.ndarray, "faces 3 2"]) -> str:
    """Data of an SVG path around projected triangles [px]; empty outside of the drawing."""
    mask = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    for corners in np.clip(2 * triangles, -30_000, 30_000).round().astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 255)
    mask = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT)
    lines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    found = []
    for line in lines:
        if cv2.contourArea(line) > 40:
            outline = (cv2.approxPolyDP(line, 2 * _TOLERANCE, True)[:, 0] - 1) / 2
            found.append("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in outline) + "Z")
    return "".join(found)
