"""Generates arms for training images: variants of colours and proportions, random serial robots, meshes, and poses
(random or recorded)."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jaxtyping import Float, Int

from ...errors import SettingsError
from ...files import output_path, write_text
from ...model.camera import Camera
from ...model.parts import PARTS, link_parts
from ...model.robot import SLENDER, Robot
from ...model.scene import Arm, Light, Scene
from ...recording import Sequence as SequenceFile
from ...rendering import Renderer

THICKNESS = (0.88, 1.15)
"""Range of the scale of link thickness, so that the network does not depend on the exact shape of an instrument."""

PERFECT_MODEL = 0.5
"""Share of scenes whose rendered arms have the exact proportions of the observed arms."""

_CHAIN_LENGTH = (0.25, 1.3)
"""Range of the sum of all link lengths [m]."""
_CHAIN_RADIUS = (0.10, 0.45)
"""Range of the first link's radius, relative to the mean link length [1]."""
_CHAIN_LIMIT = 2.6
"""Joint limits of revolute joints [rad]."""


@dataclass(frozen=True)
class PosedRobot:
    """Vertices of one arm in the camera frame."""

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]


@dataclass
class Body:
    """Triangle mesh of a robot or another object, divided into parts, for rasterisation and shading."""

    vertices: Float[np.ndarray, "V 3"]
    """Vertices of all parts, each in the frame of its link [m]."""
    normals: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    face_part: Int[np.ndarray, " F"]
    """Index of the part to which each triangle belongs."""
    shaft: int
    """Index of the part with the material of a shaft (mostly dark); -1 without a shaft."""
    shaft_axis: Float[np.ndarray, "3"]
    """Unit vector along the shaft in the frame of its link, pointing away from the tip."""
    shaft_end: Float[np.ndarray, "3"]
    """Distal end of the shaft in the frame of its link [m]."""


class RobotGeometry(Body):
    """Robot geometry for placement and shading; parts are `Robot.meshes`, and the shaft is the longest part.

    Attributes:
        part_link: link of each part.
        part_class: index into `carts_core.model.parts.PARTS` of each part.
        vertex_part: part of each vertex.
        instrument: whether the longest part is slender, as a shaft is.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        meshes = robot.meshes
        counts = [len(mesh.vertices) for mesh in meshes]
        starts = np.concatenate([[0], np.cumsum(counts)])
        self.vertices = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float32)
        self.normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32)
        faces = [mesh.faces + start for mesh, start in zip(meshes, starts[:-1], strict=True)]
        self.faces = np.concatenate(faces).astype(np.int32)
        self.face_part = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes]).astype(np.int32)
        self.vertex_part = np.repeat(np.arange(len(meshes)), counts)
        self._vertex_link = np.repeat([mesh.link for mesh in meshes], counts)
        self.part_link = np.array([mesh.link for mesh in meshes])
        self.part_class = link_parts(robot)[self.part_link]
        extents = [np.ptp(mesh.vertices, axis=0).max() for mesh in meshes]
        self.shaft = int(np.argmax(extents))
        longest = np.sort(np.ptp(meshes[self.shaft].vertices, axis=0))
        self.instrument = bool(longest[-2] < SLENDER * longest[-1])
        self.shaft_axis, self.shaft_end = self._shaft_line()

    def _shaft_line(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit direction of the shaft away from the tip, and its distal end [m]."""
        points = self.robot.meshes[self.shaft].vertices.astype(np.float64)
        centre = (points.min(0) + points.max(0)) / 2
        axis = np.zeros(3)
        axis[np.argmax(np.ptp(points, axis=0))] = 1.0
        Ts, shaft_link = self.link_transforms(np.zeros(len(self.robot.joint_names))), self.part_link[self.shaft]
        Ts_vertex, others = Ts[self._vertex_link], self._vertex_link != shaft_link
        posed = np.einsum("vij,vj->vi", Ts_vertex[:, :3, :3], self.vertices) + Ts_vertex[:, :3, 3]
        if others.any():
            tip = posed[others].mean(0)
        else:
            tip = posed[np.argmax(((posed - posed[self.vertex_part == self.shaft].mean(0)) ** 2).sum(1))]
        tip = np.linalg.inv(Ts[shaft_link])[:3] @ np.append(tip, 1.0)
        if axis @ (centre - tip) < 0:
            axis = -axis
        return axis, centre + axis * ((points - centre) @ axis).min()

    def link_transforms(self, joint_positions: np.ndarray) -> Float[np.ndarray, "links 4 4"]:
        """Forward kinematics: Ts_base_link [m] at joint positions [dofs]."""
        return self.robot.forward_kinematics(torch.as_tensor(joint_positions, dtype=torch.float64)).numpy()

    def posed(self, Ts_camera_link: Float[np.ndarray, "links 4 4"]) -> PosedRobot:
        """Vertices and normals in the camera frame."""
        vertices = np.empty_like(self.vertices)
        normals = np.empty_like(self.normals)
        for link in np.unique(self.part_link):
            chosen = self._vertex_link == link
            T = Ts_camera_link[link].astype(np.float32)
            vertices[chosen] = self.vertices[chosen] @ T[:3, :3].T + T[:3, 3]
            normals[chosen] = self.normals[chosen] @ T[:3, :3].T
        return PosedRobot(vertices, normals)


DEPTH = (0.05, 0.25)
"""Range of the distance between wrist and camera [m]."""
FOCAL_LENGTH = (0.7, 2.0)
"""Range of the focal length, in image widths [1], from whole to enlarged endoscope images."""
OUTSIDE = 0.12
"""Maximum distance of a wrist outside the image, relative to the image size [1]."""
ROBOT_DEPTH = (0.3, 2.0)
"""Range of the distance from the camera of the point by which a robot other than an instrument is placed [m]."""
_TIP_AIMED = 0.25
"""Share of instruments that are placed by a point of their jaws instead of the wrist, so that only the tips of long
jaws are in view."""
_CROSSED = 0.05
"""Maximum distance of a crossing point from the wrist [m]."""
_STIFF = 0.3
"""Joint errors of other robots, relative to joint errors of instruments [1]."""
ELEVATION = (-20.0, 60.0)
"""Range of the angle between shaft and image plane [deg]; positive if the shaft extends towards the camera."""


@dataclass(frozen=True)
class Variant:
    """One or two arms with varied appearance, to be posed, shaded and rendered."""

    geometries: tuple[RobotGeometry, ...]
    """Observed arms."""
    rendered: tuple[RobotGeometry, ...]
    """Arms of the optimizer's model: equal to the observed arms, or with slightly different proportions, as in
    reality."""
    renderer: Renderer
    """Renderer of `rendered`, for hybrid images."""


def random_variant(rng: np.random.Generator, robots: Sequence[Robot], arms: int, width: int, height: int) -> Variant:
    """Scene with `arms` arms, drawn from `robots`, with random colours and thickness."""
    chosen = [robots[int(rng.integers(len(robots)))] for _ in range(arms)]
    observed = [_vary(rng, robot) for robot in chosen]
    rendered = observed if rng.random() < PERFECT_MODEL else [_vary(rng, robot) for robot in chosen]
    light = Light(
        position=(float(rng.normal(0, 0.01)), float(rng.normal(0, 0.01)), float(rng.uniform(-0.04, 0.0))),
        ambient=float(rng.uniform(0.15, 0.4)),
        diffuse=float(rng.uniform(0.5, 0.85)),
        specular=float(rng.uniform(0.1, 0.6)),
        shininess=float(rng.uniform(8, 50)),
    )
    scene = Scene(
        tuple(Arm(f"arm{index}", robot, np.eye(4)) for index, robot in enumerate(rendered)),
        (Camera("training", width, height, (float(width), float(width), width / 2, height / 2), np.eye(4)),),
        light,
    )
    geometries = tuple(RobotGeometry(robot) for robot in observed)
    known = geometries if rendered is observed else tuple(RobotGeometry(robot) for robot in rendered)
    return Variant(geometries, known, Renderer(scene, width=width, height=height))


def _vary(rng: np.random.Generator, robot: Robot) -> Robot:
    varied = copy.copy(robot)
    thickness = rng.uniform(*THICKNESS)
    own_colors = rng.random() < 0.4
    shade = rng.uniform(0.02, 0.6)
    meshes = []
    for mesh in robot.meshes:
        extents = np.ptp(mesh.vertices, axis=0)
        scale = np.full(3, thickness * rng.uniform(0.94, 1.06))
        scale[np.argmax(extents)] = 1.0
        # Normals transform with the inverse transpose of the scaling.
        normals = mesh.normals / scale
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        color = mesh.color if own_colors else np.clip(shade * np.clip(rng.normal(1, 0.12, 3), 0.6, 1.5), 0, 1)
        if not own_colors and rng.random() < 0.7:
            color = np.clip(rng.uniform(0.15, 0.8) * np.clip(rng.normal(1, 0.08, 3), 0.6, 1.4), 0, 1)
        vertices = (mesh.vertices * scale).astype(np.float32)
        meshes.append(replace(mesh, vertices=vertices, normals=normals.astype(np.float32), color=color))
    varied.meshes = tuple(meshes)
    return varied


Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy [px]."""


@dataclass(frozen=True)
class Placement:
    """Pose and joint positions of one arm in front of the camera."""

    joint_positions: Float[np.ndarray, " dofs"]
    """Joint positions [rad, m], in the order of `Robot.joint_names`."""
    T_camera_base: Float[np.ndarray, "4 4"]


def random_intrinsics(rng: np.random.Generator, width: int, height: int, field: int) -> Intrinsics:
    """Random fx, fy, cx, cy [px] of a crop of `width` x `height` px from a camera image that is `field` px wide."""
    focal = float(np.exp(rng.uniform(*np.log(FOCAL_LENGTH)))) * field
    cx, cy = rng.uniform(0.3, 0.7) * width, rng.uniform(0.3, 0.7) * height
    return focal, focal * rng.uniform(0.98, 1.02), cx, cy


def random_placement(
    rng: np.random.Generator,
    geometry: RobotGeometry,
    intrinsics: Intrinsics,
    width: int,
    height: int,
    near: Float[np.ndarray, "3"] | None = None,
) -> Placement:
    """Random placement of an instrument, with its wrist or tip in or near the image and its shaft crossing a border, or
    of another robot, with any of its links in the image.

    Args:
        near: point of another arm [m], in front of or behind which the arm is placed, so that the arms cross.
    """
    joints = _random_joints(rng, geometry)
    Ts_base_link = geometry.link_transforms(joints)
    T_base_shaft = Ts_base_link[geometry.part_link[geometry.shaft]]
    wrist = T_base_shaft[:3, :3] @ geometry.shaft_end + T_base_shaft[:3, 3]
    axis = T_base_shaft[:3, :3] @ geometry.shaft_axis
    fx, fy, cx, cy = intrinsics
    instrument = geometry.instrument
    depth = float(np.exp(rng.uniform(*np.log(DEPTH if instrument else ROBOT_DEPTH))))
    u = rng.uniform(-OUTSIDE, 1 + OUTSIDE) * width
    v = rng.uniform(-OUTSIDE, 1 + OUTSIDE) * height
    target = np.array([(u - cx) / fx * depth, (v - cy) / fy * depth, depth])
    aimed = wrist
    if near is not None or not instrument or rng.random() < _TIP_AIMED:
        aimed = _some_point(rng, geometry, Ts_base_link, wrist, jaws=instrument and near is None)
    if near is not None:
        target = near * np.exp(rng.normal(0, 0.06)) + rng.normal(0, 0.006, 3)
    if instrument:
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(*ELEVATION))
        flat = np.cos(elevation)
        direction = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, -np.sin(elevation)])
        R = _frame(direction, rng.normal(size=3)) @ _frame(axis, rng.normal(size=3)).T
    else:
        # The robot stands upright, or hangs from a ceiling.
        tilt, roll = np.deg2rad(rng.uniform(-15, 70)), rng.normal(0, 0.15) + np.pi * (rng.random() < 0.1)
        level = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
        R = turned(np.array([0, 0, roll])) @ turned(np.array([tilt, 0, 0])) @ level
        R = R @ turned(np.array([0, 0, rng.uniform(-np.pi, np.pi)]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, target - R @ aimed
    return Placement(joints, T)


def _some_point(
    rng: np.random.Generator, geometry: RobotGeometry, Ts_base_link: np.ndarray, wrist: np.ndarray, *, jaws: bool
) -> Float[np.ndarray, "3"]:
    """Random vertex in the base frame [m], of the jaws, or within `_CROSSED` of an instrument's wrist."""
    posed = geometry.posed(Ts_base_link).vertices.astype(float)
    if jaws:
        chosen = geometry.part_class[geometry.vertex_part] == PARTS.index("jaws")
    elif geometry.instrument:
        chosen = np.linalg.norm(posed - wrist, axis=1) < _CROSSED
    else:
        # Parts are drawn with equal probability, independent of their number of vertices.
        chosen = geometry.vertex_part == rng.integers(len(geometry.part_link))
    points = posed[chosen] if chosen.any() else posed
    return points[rng.integers(len(points))]


def perturbed(rng: np.random.Generator, geometry: RobotGeometry, placement: Placement, scale: float) -> Placement:
    """Placement with simulated kinematic errors: joint errors of several degrees, and a small rotation and translation.

    A scale of 1 moves the wrist by about 3 mm and rotates joints by about 3 degrees.
    """
    joints = placement.joint_positions.copy()
    for index, kind in enumerate(geometry.robot.joint_types):
        if kind == "revolute":
            joints[index] += rng.normal(0, np.deg2rad(3.0) * scale) * (1.0 if geometry.instrument else _STIFF)
    # The arm rotates about its wrist, so that the error in the image does not increase with the length of the arm.
    shaft_link = geometry.part_link[geometry.shaft]
    T_camera_shaft = placement.T_camera_base @ geometry.link_transforms(placement.joint_positions)[shaft_link]
    T_camera_shaft_moved = placement.T_camera_base @ geometry.link_transforms(joints)[shaft_link]
    turn = turned(rng.normal(0, np.deg2rad(2.0) * scale, 3))
    wrist = T_camera_shaft[:3, :3] @ geometry.shaft_end + T_camera_shaft[:3, 3]
    # At a larger distance, the same displacement in the image requires a larger displacement in space.
    wrist = wrist + rng.normal(0, 0.003 * scale, 3) * max(1.0, np.linalg.norm(wrist) / DEPTH[1])
    R = turn @ T_camera_shaft[:3, :3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, wrist - R @ geometry.shaft_end
    return Placement(joints, T @ np.linalg.inv(T_camera_shaft_moved) @ placement.T_camera_base)


def _random_joints(rng: np.random.Generator, geometry: RobotGeometry) -> np.ndarray:
    limits = geometry.robot.joint_limits
    low = np.where(np.isfinite(limits[:, 0]), limits[:, 0], -np.pi)
    high = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.pi)
    anywhere = rng.uniform(low, high)
    # Most instruments are nearly straight, with nearly closed jaws.
    straight = np.clip(rng.normal(0, 0.4, len(low)), low, high)
    return np.where(rng.random(len(low)) < 0.6, straight, anywhere)


def _frame(axis: np.ndarray, helper: np.ndarray) -> np.ndarray:
    """Rotation whose last column is `axis`; `helper` determines the rotation about this axis."""
    x = np.cross(axis, helper)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def turned(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a rotation vector [rad]."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


_FRAMES = 200
"""Maximum number of frames of the recording whose joint positions are used."""
_TURN = np.deg2rad(8.0)
"""Standard deviation of an arm's rotation in front of the camera [rad]."""
_SHIFT = 0.06
"""Standard deviation of an arm's translation, relative to its distance from the camera [1]."""
_JOINTS = 0.12
"""Standard deviation of joint motion, relative to the joint's range in the recording [1]."""
_LEAST = np.deg2rad(6.0)
"""Minimum standard deviation of joint motion [rad]; for prismatic joints, a tenth of this value in [m]."""
_ZOOM = 0.12
"""Standard deviation of the logarithm of the focal length [1]."""


class RecordedPlacements:
    """Generator of placements similar to those in a sequence file.

    Raises:
        SequenceError: the sequence file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        sequence = SequenceFile.open(path)
        indices = sorted({round(i) for i in np.linspace(0, len(sequence) - 1, min(_FRAMES, len(sequence)))})
        self._arms = {arm.name: arm for arm in sequence.scene.arms}
        self._cameras = sequence.scene.cameras
        self._joints = {name: np.asarray(sequence.measured[name], dtype=float)[indices] for name in self._arms}
        self._mounts = [sequence.mounts(index) for index in indices]
        self._names: dict[Path, list[str]] = {}
        for name, arm in self._arms.items():
            self._names.setdefault(arm.robot.urdf, []).append(name)

    def __call__(
        self, rng: np.random.Generator, geometries: tuple[RobotGeometry, ...], size: tuple[int, int], field: int
    ) -> tuple[Intrinsics, list[Placement]]:
        """Draw intrinsics and a placement for each robot, with part of the first robot in the image.

        `size` is width and height [px] of the image, a crop of a camera image that is `field` px wide.

        Raises:
            SettingsError: the recording does not contain one of the robots.
        """
        camera = self._cameras[int(rng.integers(len(self._cameras)))]
        zoom = field / camera.width * float(np.exp(rng.normal(0, _ZOOM)))
        fx, fy = camera.intrinsics[0] * zoom, camera.intrinsics[1] * zoom
        taken: list[str] = []
        placements = []
        for geometry in geometries:
            names = self._names.get(geometry.robot.urdf)
            if names is None:
                raise SettingsError(
                    f"robot {geometry.robot.urdf} is not one of the recording's robots. Leave out `robots`."
                )
            free = [name for name in names if name not in taken] or names
            taken.append(free[int(rng.integers(len(free)))])
            placements.append(self._placement(rng, taken[-1], geometry, camera))
        seen = _points(geometries[0], placements[0])
        seen = seen[seen[:, 2] > 1e-3]
        if not len(seen):
            return (fx, fy, size[0] / 2, size[1] / 2), placements
        x, y, z = seen[int(rng.integers(len(seen)))]
        # The principal point is chosen such that this point is at a random position in the image.
        u, v = rng.uniform(0.1, 0.9, 2) * size
        return (fx, fy, u - fx * x / z, v - fy * y / z), placements

    def _placement(self, rng: np.random.Generator, name: str, geometry: RobotGeometry, camera: Camera) -> Placement:
        rows = self._joints[name]
        least = np.where(np.array(geometry.robot.joint_types) == "revolute", _LEAST, 0.1 * _LEAST)
        spread = np.maximum(_JOINTS * np.ptp(rows, axis=0), least)
        low, high = geometry.robot.joint_limits.T
        frame = int(rng.integers(len(rows)))
        joints = np.clip(rows[frame] + rng.normal(0, 1, rows.shape[1]) * spread, low, high)
        T_mount_world = self._mounts[frame].get(camera.name, np.eye(4))
        T_camera_base = camera.T_camera_world @ T_mount_world @ self._arms[name].T_world_base
        placement = Placement(joints, T_camera_base)
        ahead = _points(geometry, placement)
        ahead = ahead[ahead[:, 2] > 0]
        distance = float(np.median(ahead[:, 2])) if len(ahead) else 0.1
        pivot = ahead.mean(0) if len(ahead) else np.array([0.0, 0.0, distance])
        turn = np.eye(4)
        turn[:3, :3] = turned(rng.normal(0, _TURN, 3))
        turn[:3, 3] = pivot - turn[:3, :3] @ pivot + rng.normal(0, _SHIFT * distance, 3)
        return Placement(joints, turn @ T_camera_base)


def _points(geometry: RobotGeometry, placement: Placement) -> Float[np.ndarray, "V 3"]:
    """Vertices of the arm in the camera frame [m]."""
    Ts_base_link = geometry.link_transforms(placement.joint_positions)
    return geometry.posed(placement.T_camera_base @ Ts_base_link).vertices.astype(float)


def random_chain(rng: np.random.Generator) -> Robot:
    """Random serial robot with three to seven joints, round, boxy or railed links, and a gripper or tool."""
    with TemporaryDirectory(prefix="carts-chain-") as folder:
        path = output_path(Path(folder), "chain.urdf")
        write_text(path, _chain_urdf(rng))
        return Robot.load(path.path)


def _chain_urdf(rng: np.random.Generator) -> str:
    joints = int(rng.integers(3, 8))
    lengths = rng.uniform(0.5, 1.5, joints + 1) * np.linspace(1.2, 0.7, joints + 1)
    lengths *= np.exp(rng.uniform(*np.log(_CHAIN_LENGTH))) / lengths.sum()
    radius = lengths.mean() * rng.uniform(*_CHAIN_RADIUS)
    radii = np.maximum(radius * np.linspace(1.0, rng.uniform(0.4, 1.0), joints + 1), 0.012)
    elements = [f'<link name="link_0">{_visuals(rng, lengths[0], 1.3 * radii[0])}</link>']
    bent = rng.random() < 0.3
    for index in range(joints):
        axis = ("0 0 1", "0 1 0", "1 0 0")[0 if index % 2 == 0 else int(rng.integers(1, 3))]
        # Links of some arms are offset sideways at the joints, as in lightweight robots.
        aside = radii[index] * rng.uniform(-1.5, 1.5) if bent else 0.0
        shape = _visuals(rng, lengths[index + 1], radii[index + 1])
        if index == joints - 1:
            shape += _tool(rng, lengths[-1], radii[-1])
        elements.append(
            f'<joint name="joint_{index}" type="revolute"><parent link="link_{index}"/><child link="link_{index + 1}"/>'
            f'<origin xyz="{aside:.4f} 0 {lengths[index]:.4f}"/><axis xyz="{axis}"/>'
            f'<limit lower="-{_CHAIN_LIMIT}" upper="{_CHAIN_LIMIT}" effort="1" velocity="1"/></joint>'
            f'<link name="link_{index + 1}">{shape}</link>'
        )
    return f'<robot name="chain">{"".join(elements)}</robot>'


def _visuals(rng: np.random.Generator, length: float, radius: float) -> str:
    """URDF visuals of a link along z: a joint housing, and a tube, box or pair of rails."""
    housing = radius * rng.uniform(1.0, 1.5)
    shapes = [f'<sphere radius="{housing:.4f}"/>', f'<cylinder radius="{housing:.4f}" length="{2 * housing:.4f}"/>']
    visuals = [_visual(shapes[int(rng.integers(2))], "0 0 0", "1.5708 0 0" if rng.random() < 0.5 else "0 0 0")]
    kind = rng.choice(["tube", "box", "rails"], p=[0.6, 0.25, 0.15])
    middle = f"0 0 {length / 2:.4f}"
    if kind == "tube":
        visuals.append(_visual(f'<cylinder radius="{0.85 * radius:.4f}" length="{length:.4f}"/>', middle))
    elif kind == "box":
        width, depth = radius * rng.uniform(1.0, 2.2, 2)
        visuals.append(_visual(f'<box size="{width:.4f} {depth:.4f} {length:.4f}"/>', middle))
    else:
        for side in (-1, 1):
            box = f'<box size="{0.4 * radius:.4f} {1.4 * radius:.4f} {length:.4f}"/>'
            visuals.append(_visual(box, f"{side * 0.8 * radius:.4f} 0 {length / 2:.4f}"))
    return "".join(visuals)


def _tool(rng: np.random.Generator, length: float, radius: float) -> str:
    if rng.random() < 0.3:
        long = radius * rng.uniform(1.5, 4)
        return _visual(f'<cylinder radius="{radius / 2:.4f}" length="{long:.4f}"/>', f"0 0 {length + long / 2:.4f}")
    gap, finger = radius * rng.uniform(0.3, 1.0), radius * rng.uniform(1.5, 4.0)
    box = f'<box size="{2.4 * radius:.4f} {radius:.4f} {0.6 * radius:.4f}"/>'
    visuals = [_visual(box, f"0 0 {length:.4f}")]
    for side in (-1, 1):
        box = f'<box size="{0.4 * radius:.4f} {0.7 * radius:.4f} {finger:.4f}"/>'
        visuals.append(_visual(box, f"{side * (gap + 0.2 * radius):.4f} 0 {length + finger / 2:.4f}"))
    return "".join(visuals)


def _visual(shape: str, xyz: str, rpy: str = "0 0 0") -> str:
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></visual>'
