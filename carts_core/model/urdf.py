"""What is used of a URDF: links with what is seen of them, and joints. `urdf_check` has passed it before."""

import math
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

NO_LIMIT = 1e3
"""A larger joint limit [rad], [m] means none."""


@dataclass(frozen=True)
class Box:
    """A box about the origin."""

    size: Float[np.ndarray, "3"]
    """[m]"""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder about the origin, along z."""

    radius: float
    """[m]"""
    length: float
    """[m]"""


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin."""

    radius: float
    """[m]"""


@dataclass(frozen=True)
class MeshFile:
    """A mesh from a file."""

    name: str
    """As the URDF has it."""
    scale: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Visual:
    """What is seen of a link."""

    shape: Box | Cylinder | Sphere | MeshFile
    T_link_shape: Float[np.ndarray, "4 4"] | None
    """None: the shape lies in the link's frame."""
    rgba: Float[np.ndarray, "4"] | None
    """None where the URDF gives no colour."""


@dataclass(frozen=True)
class Link:
    """A rigid part of a robot."""

    name: str
    visuals: tuple[Visual, ...]


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another one: `factor * its position + offset`."""

    joint: str
    factor: float
    offset: float
    """[rad] or [m]"""


@dataclass(frozen=True)
class Joint:
    """What joins two links."""

    name: str
    kind: str
    """`revolute`, `continuous`, `prismatic` or `fixed`."""
    parent: str
    child: str
    T_parent_joint: Float[np.ndarray, "4 4"]
    """Where the child is while the joint is at 0."""
    axis: Float[np.ndarray, "3"]
    """Unit vector in the joint's frame."""
    limits: tuple[float, float]
    """[rad] or [m]; infinite where there is none."""
    mimic: Mimic | None

    @property
    def moves(self) -> bool:
        """Whether it is not fixed."""
        return self.kind != "fixed"

    @property
    def turns(self) -> bool:
        """Whether its position is an angle."""
        return self.kind in ("revolute", "continuous")


@dataclass(frozen=True)
class Urdf:
    """A robot's tree of links and joints."""

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]

    @property
    def root(self) -> str:
        """The link that is no joint's child."""
        children = {joint.child for joint in self.joints}
        return next(link.name for link in self.links if link.name not in children)

    @property
    def free_joints(self) -> tuple[Joint, ...]:
        """Those that move and follow no other one."""
        return tuple(joint for joint in self.joints if joint.moves and joint.mimic is None)

    def downwards(self) -> list[Joint]:
        """The joints, each after the one that moves its parent."""
        below: dict[str, list[Joint]] = {}
        for joint in self.joints:
            below.setdefault(joint.parent, []).append(joint)
        order = list(below.get(self.root, ()))
        for joint in order:
            order += below.get(joint.child, ())
        return order


def read_urdf(root: Element) -> Urdf:
    """The robot of a URDF's outermost element.

    Raises:
        ValueError: something is missing or cannot be read.
    """
    colors = {material.get("name"): _rgba(material) for material in root.findall("material")}
    return Urdf(
        root.attrib["name"],
        tuple(
            Link(link.attrib["name"], tuple(_visual(visual, colors) for visual in link.findall("visual")))
            for link in root.findall("link")
        ),
        tuple(_joint(joint) for joint in root.findall("joint")),
    )


def _visual(visual: Element, colors: dict[str | None, np.ndarray | None]) -> Visual:
    geometry, material = visual.find("geometry"), visual.find("material")
    if geometry is None or not len(geometry):
        raise ValueError("a <visual> without a <geometry>")
    rgba = None if material is None else _rgba(material)
    if material is not None and rgba is None:
        rgba = colors.get(material.get("name"))
    return Visual(_shape(geometry[0]), _transform(visual), rgba)


def _shape(shape: Element) -> Box | Cylinder | Sphere | MeshFile:
    match shape.tag:
        case "box":
            return Box(_required(shape, "size"))
        case "cylinder":
            return Cylinder(float(_required(shape, "radius")[0]), float(_required(shape, "length")[0]))
        case "sphere":
            return Sphere(float(_required(shape, "radius")[0]))
        case "mesh":
            return MeshFile(shape.attrib["filename"], _numbers(shape, "scale", "1") * np.ones(3))
    raise ValueError(f"a <geometry> of an unknown kind, <{shape.tag}>")


def _joint(joint: Element) -> Joint:
    T, axis, mimic = _transform(joint), joint.find("axis"), joint.find("mimic")
    along = np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis, "xyz", "1 0 0")
    kind = joint.attrib["type"]
    return Joint(
        joint.attrib["name"],
        kind,
        _end(joint, "parent"),
        _end(joint, "child"),
        np.eye(4) if T is None else T,
        # The axis of a fixed joint may be anything.
        along / max(float(np.linalg.norm(along)), 1e-9),
        _limits(joint.find("limit"), kind),
        None if mimic is None else _mimic(mimic),
    )


def _end(joint: Element, role: str) -> str:
    end = joint.find(role)
    if end is None:
        raise ValueError(f"a <joint> without a <{role}>")
    return end.attrib["link"]


def _mimic(mimic: Element) -> Mimic:
    factor, offset = (float(_numbers(mimic, *given)[0]) for given in (("multiplier", "1"), ("offset", "0")))
    return Mimic(mimic.attrib["joint"], factor, offset)


def _limits(limit: Element | None, kind: str) -> tuple[float, float]:
    if kind == "continuous" or limit is None or limit.get("lower") is None or limit.get("upper") is None:
        return -math.inf, math.inf
    lower, upper = (float(_numbers(limit, key, "0")[0]) for key in ("lower", "upper"))
    return _bounded(lower), _bounded(upper)


def _bounded(limit: float) -> float:
    # Some robots write a huge number for no limit.
    return math.copysign(math.inf, limit) if abs(limit) > NO_LIMIT else limit


def _transform(element: Element) -> Float[np.ndarray, "4 4"] | None:
    """What an element's <origin> says; None where it has none."""
    origin = element.find("origin")
    if origin is None:
        return None
    T = np.eye(4)
    T[:3, 3] = _numbers(origin, "xyz", "0 0 0")
    (cr, cp, cy), (sr, sp, sy) = (function(_numbers(origin, "rpy", "0 0 0")) for function in (np.cos, np.sin))
    # Roll about x, then pitch about y, then yaw about z, all of them axes that stay.
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return T


def _rgba(material: Element) -> Float[np.ndarray, "4"] | None:
    color = material.find("color")
    return None if color is None else _numbers(color, "rgba", "1 1 1 1")


def _required(shape: Element, key: str) -> np.ndarray:
    if shape.get(key) is None:
        raise ValueError(f"a <{shape.tag}> without its {key}")
    return _numbers(shape, key, "")


def _numbers(element: Element, key: str, default: str) -> np.ndarray:
    return np.array([float(word) for word in (element.get(key) or default).replace(",", " ").split()])
