"""Robot model: checked URDF, joints, differentiable forward kinematics and link meshes."""

import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from ..arrays import Array, array_if_faster, converted, library
from ..errors import RobotError
from ..files.reading import MESH, ROBOT, is_regular, read_text
from ..reprs import short_repr
from ..wording import listed, shown
from . import mesh_cache
from .instruments import robot_file
from .link_mesh import CLUSTERING_RATIO, OPAQUE, Decimation, LinkMesh, collada_asset, mesh_path

if TYPE_CHECKING:
    import trimesh

NO_LIMIT = 1e3
"""Joint limit [rad], [m] above which a joint is considered unlimited."""
ROUND_OFF = 1e-5
"""Distance [rad] below which angles are set to a multiple of 90 degrees: URDF exporters print 1.5708 for pi/2."""


def exact_right_angles(root: Element) -> None:
    """Replace every `rpy` angle of a URDF that is a rounded multiple of pi/2 by the exact value.

    For an instrument, the error of 3.7e-6 rad of "1.5708" is more than a micrometre at the tip.
    """
    for origin in root.iter("origin"):
        if rpy := origin.get("rpy"):
            angles = np.array([float(value) for value in rpy.split()])
            right = np.round(angles / (np.pi / 2)) * (np.pi / 2)
            angles = np.where(np.abs(angles - right) < ROUND_OFF, right, angles)
            origin.set("rpy", " ".join(repr(float(angle)) for angle in angles))


@dataclass(frozen=True, eq=False)
class _Joint:
    """A joint of a checked URDF."""

    name: str
    type: str
    parent: str
    child: str
    origin: Float[np.ndarray, "4 4"]
    """T_parent_child at position 0 [m]."""
    axis: Float[np.ndarray, "3"]
    mimic: tuple[str, float, float] | None
    """Mimicked joint, multiplier and offset."""
    limits: tuple[float, float]
    """Lower and upper limit [rad, m]; infinite without a limit."""

    __repr__ = short_repr

    @property
    def independent(self) -> bool:
        """Whether the joint is a degree of freedom."""
        return self.type != "fixed" and self.mimic is None

    @staticmethod
    def of(element: Element) -> "_Joint":
        """Joint of an element that `parsed_urdf` has checked."""
        kind = element.get("type", "")
        parent, child = (_attributes(element, role).get("link", "") for role in ("parent", "child"))
        origin, mimic, limit = (_attributes(element, part) for part in ("origin", "mimic", "limit"))
        T_parent_child = np.eye(4)
        T_parent_child[:3, :3] = _rotation(*_numbers(origin.get("rpy", "0 0 0")))
        T_parent_child[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
        follows = None
        if element.find("mimic") is not None:
            follows = mimic.get("joint", ""), float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
        lower, upper = -math.inf, math.inf
        if kind != "continuous" and "lower" in limit and "upper" in limit:
            # Some URDFs have a huge limit for an unlimited joint.
            lower, upper = (
                math.copysign(math.inf, value) if abs(value) > NO_LIMIT else value
                for value in (float(limit["lower"]), float(limit["upper"]))
            )
        axis = np.array(_numbers(_attributes(element, "axis").get("xyz", "1 0 0")))
        return _Joint(element.get("name", ""), kind, parent, child, T_parent_child, axis, follows, (lower, upper))

    def matrices(self) -> Float[np.ndarray, "4 4 4"]:
        """Constant matrices C, S, G, P with T_parent_child = C + S sin(q) + G cos(q) + P q.

        For a revolute joint with the cross product matrix K of its unit axis, Rodrigues' formula is
        R = I + K^2 + K sin(q) - K^2 cos(q).
        """
        matrices = np.zeros((4, 4, 4))
        matrices[0] = np.eye(4)
        if self.type != "fixed":
            x, y, z = axis = self.axis / np.linalg.norm(self.axis)
            if self.type == "prismatic":
                matrices[3, :3, 3] = axis
            else:
                K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
                matrices[0, :3, :3] += K @ K
                matrices[1, :3, :3], matrices[2, :3, :3] = K, -K @ K
        return self.origin @ matrices


def _attributes(element: Element, part: str) -> Mapping[str, str]:
    """Attributes of a child element; empty without it."""
    found = element.find(part)
    return {} if found is None else found.attrib


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _rotation(roll: float, pitch: float, yaw: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about the fixed axes x, y and z in this order, as in a URDF."""
    (sr, sp, sy), (cr, cp, cy) = np.sin([roll, pitch, yaw]), np.cos([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


_JOINT_PARTS = ("parent", "child", "origin", "axis", "mimic")
"""Elements of a joint that define its motion; limits and dynamics have required attributes, which many URDFs omit."""


def _links_and_joints(root: Element) -> str:
    """URDF with only the elements that pytorch-kinematics requires, since it warns about other elements."""
    robot = Element("robot", root.attrib)
    for child in root:
        if child.tag == "link":
            SubElement(robot, "link", child.attrib)
        elif child.tag == "joint":
            joint = SubElement(robot, "joint", child.attrib)
            joint.extend(part for part in child if part.tag in _JOINT_PARTS)
            if child.find("axis") is None:
                SubElement(joint, "axis", xyz="1 0 0")  # URDF's default axis; that of pytorch-kinematics is z
    return ElementTree.tostring(robot, encoding="unicode")


class Kinematics:
    """Forward kinematics of a robot's links from its independent joint positions.

    The transform of a link in its parent's frame is C + S sin(q) + G cos(q) + P q with constant matrices C, S, G and P,
    where q is the position of the joint between them; see `_Joint.matrices`. pytorch-kinematics computes the transforms
    of tensors that require gradients or are on a GPU.

    Args:
        root: the checked URDF.
        base_link: reference frame of the transforms, which must not move with a joint; None for the root.
    """

    def __init__(self, root: Element, base_link: str | None, source: Path) -> None:
        joints = {joint.name: joint for joint in map(_Joint.of, root.findall("joint"))}
        self.joint_names: tuple[str, ...] = tuple(name for name, joint in joints.items() if joint.independent)
        self.joint_types: tuple[str, ...] = tuple(
            "prismatic" if joints[name].type == "prismatic" else "revolute" for name in self.joint_names
        )
        self.joint_limits: Float[np.ndarray, "dofs 2"] = np.array(
            [joints[name].limits for name in self.joint_names], np.float64
        ).reshape(-1, 2)
        above = {joint.child: joint for joint in joints.values()}
        links = _from_root([link.get("name", "") for link in root.findall("link")], above)
        self.base_link = base_link or links[0]
        if self.base_link not in links:
            raise RobotError(f"{source}: there is no link {self.base_link!r}. The links are: {', '.join(links)}.")
        self._frame_index = {name: index for index, name in enumerate(links)}
        self._parents = [self._frame_index[above[name].parent] for name in links[1:]]
        moving = [above[name] for name in links[1:]]
        self._joints = [joint.name for joint in moving]
        self._urdf, self._chains = _links_and_joints(root), {}
        matrices = np.array([joint.matrices() for joint in moving]).reshape(-1, 4, 4, 4)
        self._mimics, self._matrices = _mimic_matrix(joints, moving, self.joint_names), matrices.swapaxes(0, 1)
        probes = np.stack([np.zeros(len(self.joint_names)), np.full(len(self.joint_names), 0.1)])
        Ts_root_base = self._Ts_root(probes)[self._frame_index[self.base_link]]
        if not np.allclose(Ts_root_base[0], Ts_root_base[1]):
            raise RobotError(f"{source}: base link {self.base_link!r} moves with a joint. Choose a fixed link.")
        self._T_base_root = np.linalg.inv(Ts_root_base[0])

    def _Ts_root(self, joint_positions: Float[Array, "n dofs"]) -> Sequence[Float[Array, "n 4 4"]]:
        """Transforms of all links to the root, in the order of `_frame_index`."""
        expand, offset = (converted(values, joint_positions) for values in self._mimics)
        positions = joint_positions @ expand.T + offset
        if library(positions) is not np:
            return self._Ts_root_of_tensor(positions)
        (C, S, G, P), q = self._matrices, positions[:, :, None, None]
        Ts_parent_link = C + S * np.sin(q) + G * np.cos(q) + P * q
        Ts = [np.broadcast_to(np.eye(4), (len(q), 4, 4))]
        for index, parent in enumerate(self._parents):
            Ts.append(Ts[parent] @ Ts_parent_link[:, index])
        return Ts

    def _Ts_root_of_tensor(self, joint_positions: Float[Array, "n joints"]) -> Float[Array, "links n 4 4"]:
        """Transforms of all links to the root, by pytorch-kinematics; joint positions are in the order of `_joints`."""
        device = joint_positions.device
        if device not in self._chains:
            import pytorch_kinematics  # noqa: PLC0415

            chain = pytorch_kinematics.build_chain_from_urdf(self._urdf)
            chain = chain.to(dtype=joint_positions.dtype, device=device)
            joints = [self._joints.index(name) for name in chain.get_joint_parameter_names()]
            links = [int(chain.get_frame_indices(name)[0]) for name in self._frame_index]
            self._chains[device] = chain, joints, links
        chain, joints, links = self._chains[device]
        return chain.forward_kinematics_tensor(joint_positions[:, joints])[links]

    def __call__(
        self, joint_positions: Float[Array, "*batch dofs"], link_names: tuple[str, ...]
    ) -> Float[Array, "*batch links 4 4"]:
        """Ts_base_link [m] of the named links; computed in double precision, returned in the precision of the input.

        Raises:
            RobotError: the last dimension is not the number of degrees of freedom, or a link does not exist.
        """
        dofs = len(self.joint_names)
        if joint_positions.shape[-1] != dofs:
            raise RobotError(
                f"got {joint_positions.shape[-1]} joint positions for a robot with {dofs} degrees of freedom: "
                f"{', '.join(self.joint_names)}."
            )
        for name in link_names:
            if name not in self._frame_index:
                raise RobotError(f"the robot has no link {shown(name)}. Its links: {listed(self._frame_index)}.")
        given = array_if_faster(joint_positions)
        of, q = library(given), given.reshape(-1, dofs)
        double = q.astype(np.float64) if of is np else q.double()
        Ts_root = self._Ts_root(double)
        Ts_root_link = of.stack([Ts_root[self._frame_index[name]] for name in link_names], 1)
        Ts = (converted(self._T_base_root, double) @ Ts_root_link).reshape(*joint_positions.shape[:-1], -1, 4, 4)
        return converted(Ts, joint_positions) if of is np else Ts.to(joint_positions.dtype)


def _from_root(links: list[str], above: Mapping[str, _Joint]) -> list[str]:
    """Links in topological order, parents first; `above` is the parent joint of each link except the root."""
    ordered = [link for link in links if link not in above]
    children: dict[str, list[str]] = {}
    for link in links:
        if link in above:
            children.setdefault(above[link].parent, []).append(link)
    for link in ordered:  # the list is extended in the loop
        ordered += children.get(link, [])
    return ordered


def _mimic_matrix(
    joints: Mapping[str, _Joint], moving: Sequence[_Joint], independent: Sequence[str]
) -> tuple[Float[np.ndarray, "joints dofs"], Float[np.ndarray, " joints"]]:
    """Matrix and offset that map independent joint positions to the positions of all joints; 0 for fixed joints."""
    expand, offset = np.zeros((len(moving), len(independent))), np.zeros(len(moving))
    for row, joint in enumerate(moving):
        if joint.type == "fixed":
            continue
        factor, leader = 1.0, joint
        while leader.mimic is not None:
            name, multiplier, shift = leader.mimic
            offset[row] += factor * shift
            factor *= multiplier
            leader = joints[name]
        expand[row, independent.index(leader.name)] = factor
    return expand, offset


_MAX_ELEMENTS = 100_000
_MAX_LINKS = 1_000
_DEEPEST = 32
_FARTHEST = 1e3
"""Maximum coordinate, size or angle of a robot [m], [rad]."""
_MAX_FACTOR = 1e6
"""Maximum scale of a mesh and factor of a mimic joint; the minimum is its inverse."""
_MIN_AXIS_LENGTH = 1e-6
_TYPES = ("revolute", "continuous", "prismatic", "fixed")
_XACRO = "ros.org/wiki/xacro}"


def parsed_urdf(text: str, source: Path) -> Element:
    """Parse and check a URDF; returns its root element.

    Raises:
        RobotError: the text is not a URDF, links and joints do not form a tree, or a number is not finite or out of
            range.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RobotError(
            f"robot {source} declares a document type or entities, which are not allowed in a URDF. Remove them."
        )
    if text.count("<") > 2 * _MAX_ELEMENTS:
        raise RobotError(f"robot {source} has more than {_MAX_ELEMENTS:,} elements. Export only the visual model.")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise RobotError(f"robot {source} is not a readable URDF ({error}). Check it with a URDF viewer.") from error
    _check_elements(root, source)
    _check_tree(root, source)
    for origin in root.iter("origin"):
        _vector(origin, "xyz", 3, source)
        _vector(origin, "rpy", 3, source)
    for joint in root.findall("joint"):
        _check_joint(joint, source)
    for geometry in root.iter("geometry"):
        _check_geometry(geometry, source)
    for color in root.iter("color"):
        _vector(color, "rgba", 4, source, smallest=0.0)
    return root


def _check_elements(root: Element, source: Path) -> None:
    if root.tag != "robot" or not root.get("name"):
        raise RobotError(f"robot {source} is not a URDF: its outermost element must be <robot name=...>.")
    level, count = [root], 0
    for _ in range(_DEEPEST):
        count += len(level)
        if any(_XACRO in str(element.tag) for element in level):
            raise RobotError(
                f"robot {source} is a xacro file. Expand it first: xacro {source.name} > robot.urdf "
                "(for an instrument of dvrk_model: carts robot MODEL --instrument NUMBER)."
            )
        level = [child for element in level for child in element]
        if not level:
            break
    if level or count > _MAX_ELEMENTS:
        raise RobotError(
            f"robot {source} is nested more than {_DEEPEST} levels deep or has more than {_MAX_ELEMENTS} elements."
        )


def _check_tree(root: Element, source: Path) -> None:
    """Check that names are unique and that joints connect all links into one tree."""
    links, joints = root.findall("link"), root.findall("joint")
    if not 1 <= len(links) <= _MAX_LINKS or len(joints) > _MAX_LINKS:
        raise RobotError(f"robot {source} has {len(links)} links; allowed: 1 to {_MAX_LINKS}.")
    for kind, elements in (("link", links), ("joint", joints)):
        counts = Counter(element.get("name", "") for element in elements)
        if wrong := [name for name, count in counts.items() if count > 1 or not name]:
            raise RobotError(
                f"robot {source}: every {kind} needs a unique name; missing or repeated: {listed(map(repr, wrong))}."
            )
    parents: dict[str, str] = {}
    names = {link.get("name") for link in links}
    for joint in joints:
        parent, child = (_link_of(joint, role, names, source) for role in ("parent", "child"))
        if child in parents:
            raise RobotError(f"robot {source}: link {child!r} is the child of two joints. A robot must be a tree.")
        parents[child] = parent
    roots = [name for link in links if (name := link.get("name", "")) not in parents]
    if len(roots) != 1:
        found = "no link without a parent" if not roots else f"several links without a parent: {listed(roots)}"
        raise RobotError(f"robot {source} has {found}. Its joints must connect all links into one tree.")
    # Each link is the child of at most one joint, so links that do not reach the root form a loop.
    for start in parents:
        link = start
        for _ in range(len(parents)):
            link = parents.get(link, link)
        if link != roots[0]:
            raise RobotError(f"robot {source}: links form a loop at {start!r}. A robot must be a tree.")
    _check_mimics(joints, source)


def _link_of(joint: Element, role: str, names: set[str | None], source: Path) -> str:
    element = joint.find(role)
    name = None if element is None else element.get("link")
    if name is None or name not in names:
        raise RobotError(
            f"robot {source}: joint {joint.get('name')!r} names the {role} link {name!r}, which does not exist. "
            f"The links are: {listed(sorted(filter(None, names)))}."
        )
    return name


def _check_mimics(joints: list[Element], source: Path) -> None:
    moving = {joint.get("name"): joint.find("mimic") for joint in joints if joint.get("type") != "fixed"}
    for joint in joints:
        name, mimic = joint.get("name"), joint.find("mimic")
        for _ in range(len(joints) + 1):
            if mimic is None:
                break
            _number(mimic, "multiplier", source, _MAX_FACTOR)
            _number(mimic, "offset", source)
            if mimic.get("joint") not in moving:
                raise RobotError(
                    f"robot {source}: joint {name!r} mimics {mimic.get('joint')!r}, which is not a movable joint."
                )
            mimic = moving[mimic.get("joint")]
        else:
            raise RobotError(
                f"robot {source}: joint {name!r} mimics itself, directly or indirectly. Let it mimic a movable joint."
            )


def _check_joint(joint: Element, source: Path) -> None:
    name, kind = joint.get("name"), joint.get("type")
    if kind not in _TYPES:
        raise RobotError(f"robot {source}: joint {name!r} is of type {kind!r}; allowed: {', '.join(_TYPES)}.")
    if (axis := joint.find("axis")) is not None and (values := _vector(axis, "xyz", 3, source)):
        if kind != "fixed" and math.hypot(*values) < _MIN_AXIS_LENGTH:
            raise RobotError(f"robot {source}: the axis of joint {name!r} has zero length: {axis.get('xyz')!r}.")
    if (limit := joint.find("limit")) is not None:
        lower, upper = (_number(limit, key, source, math.inf) for key in ("lower", "upper"))
        if kind in ("revolute", "prismatic") and (lower or 0.0) > (upper or 0.0):
            raise RobotError(f"robot {source}: joint {name!r} has a lower limit {lower} above its upper limit {upper}.")


def _check_geometry(geometry: Element, source: Path) -> None:
    for shape in geometry:
        if shape.tag == "mesh":
            if not shape.get("filename"):
                raise RobotError(f'robot {source}: a <mesh> has no file name. Give one, such as filename="link.stl".')
            scale = _floats(shape, "scale", source)
            if scale and (
                len(scale) not in (1, 3)
                or not 1 / _MAX_FACTOR <= min(map(abs, scale)) <= max(map(abs, scale)) <= _MAX_FACTOR
            ):
                raise _wrong(shape, "scale", source, "one or three nonzero factors of at most a million")
        for key, count in (("size", 3), ("radius", 1), ("length", 1)):
            _vector(shape, key, count, source, smallest=1 / _MAX_FACTOR)


def _floats(element: Element, key: str, source: Path) -> list[float]:
    text = (element.get(key) or "").replace(",", " ")
    try:
        return list(_finite(text.split()))
    except ValueError as error:
        raise _wrong(element, key, source, "finite numbers") from error


def _finite(words: list[str]) -> Iterator[float]:
    for word in words:
        value = float(word)
        if not math.isfinite(value):
            raise ValueError(word)
        yield value


def _vector(element: Element, key: str, count: int, source: Path, smallest: float = -_FARTHEST) -> list[float]:
    """Numbers of an attribute; empty if absent."""
    values = _floats(element, key, source)
    if element.get(key) is not None and (
        len(values) != count or not smallest <= min(values) <= max(values) <= _FARTHEST
    ):
        raise _wrong(element, key, source, f"{count} numbers from {smallest:g} to {_FARTHEST:g}")
    return values


def _number(element: Element, key: str, source: Path, largest: float = _FARTHEST) -> float | None:
    values = _floats(element, key, source)
    if element.get(key) is not None and (len(values) != 1 or abs(values[0]) > largest):
        raise _wrong(element, key, source, "one finite number")
    return values[0] if values else None


def _wrong(element: Element, key: str, source: Path, allowed: str) -> RobotError:
    return RobotError(f"robot {source}: <{element.tag} {key}={shown(element.get(key))}> must be {allowed}.")


INSTRUMENT_TOLERANCE = 2e-4
"""Maximum surface deviation by decimation of an instrument [m]."""
REACH_TOLERANCE = 1e-3
"""Maximum surface deviation for other robots, relative to their reach [1]."""
SLENDER = 0.1
"""Maximum width of a shaft, relative to its length [1]."""


class Robot:
    """Articulated robot with link meshes, created by `Robot.load`.

    Attributes:
        name: the URDF's robot name.
        urdf: path of the URDF.
        base_link: reference frame of link transforms.
        joint_names: independent degrees of freedom; a mimic joint belongs to the joint that it mimics.
        joint_types: "revolute" or "prismatic", per degree of freedom.
        joint_limits: lower and upper limit per degree of freedom [dofs, 2], [rad] or [m]; infinite without limits.
        unlimited: degrees of freedom [dofs] that are revolute without limits, whose positions are equivalent modulo
            2 pi.
        link_names: links with a visual mesh.
        meshes: parts of these links; `LinkMesh.link` indexes `link_names`.
        decimation: summary of the decimation of the meshes.
        remarks: sentences on changes to meshes (scaling by the file's unit, vertex clustering, which may exceed the
            tolerance), on ignored up axes, and on omitted translucent visuals.
    """

    def __init__(
        self,
        name: str,
        urdf: Path,
        kinematics: Kinematics,
        link_names: tuple[str, ...],
        meshes: tuple[LinkMesh, ...],
        decimation: Decimation,
        remarks: tuple[str, ...] = (),
    ) -> None:
        self.name = name
        self.urdf = urdf
        self.base_link = kinematics.base_link
        self.joint_names = kinematics.joint_names
        self.joint_types = kinematics.joint_types
        self.joint_limits = kinematics.joint_limits
        self.unlimited: Bool[np.ndarray, " dofs"] = (np.array(self.joint_types) == "revolute") & np.isinf(
            self.joint_limits
        ).all(1)
        self.link_names = link_names
        self.meshes = meshes
        self.decimation = decimation
        self.remarks = remarks
        self._kinematics = kinematics

    def difference(self, positions: ArrayLike, reference: ArrayLike) -> Float[np.ndarray, "*batch dofs"]:
        """Difference of joint positions [..., dofs] [rad, m]; by at most pi for joints without limits."""
        step = np.asarray(positions, np.float64) - np.asarray(reference, np.float64)
        return step - np.where(self.unlimited, 2.0 * np.pi * np.round(step / (2.0 * np.pi)), 0.0)

    def __repr__(self) -> str:
        faces = sum(len(mesh.faces) for mesh in self.meshes)
        return f"Robot({self.name!r}, {len(self.joint_names)} degrees of freedom, {faces} triangles)"

    @staticmethod
    def load(
        urdf: Path | str,
        *,
        base_link: str | None = None,
        max_faces: int = 12_000,
        tolerance: float | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> "Robot":
        """Read a URDF and its visual meshes; decimated meshes are cached.

        Args:
            urdf: path of the URDF, to which mesh paths are relative, or `builtin:NAME`.
            base_link: reference frame of the link transforms, by default the root of the URDF.
            max_faces: total number of triangles above which meshes are decimated.
            tolerance: largest surface deviation by decimation [m]; by default 0.2 mm for an instrument, which has a
                slender shaft, and a thousandth of the reach for other robots.

        Raises:
            RobotError: the URDF or a mesh is missing or invalid, or `base_link` does not exist.
        """
        # An absolute path stays valid if the working directory changes.
        urdf = robot_file(urdf).absolute()
        report = progress or (lambda line: None)
        try:
            root = parsed_urdf(read_text(urdf, ROBOT), urdf)
            exact_right_angles(root)
            kinematics = Kinematics(root, base_link, urdf)
        except FileNotFoundError as error:
            raise RobotError(f"robot {urdf} is missing. Give the path of a URDF file.") from error
        except RobotError:
            raise
        except Exception as error:  # the parser raises many types of exceptions
            raise RobotError(f"robot {urdf} is not a readable URDF ({error}). Check it with a URDF viewer.") from error
        if not kinematics.joint_names:
            raise RobotError(
                f"robot {root.get('name')} ({urdf}) has no movable joint. Use a robot with movable joints."
            )
        name, files = root.get("name", ""), _mesh_files(root, urdf)
        link_names = tuple(link.get("name", "") for link in root.findall("link") if link.find("visual") is not None)
        limits = max_faces, tolerance
        meshes, decimation = mesh_cache.cached_meshes(
            _cache_key(files, kinematics, urdf, limits),
            lambda: _prepared_meshes(root, kinematics, urdf, link_names, limits, report),
        )
        if not meshes:
            raise RobotError(f"robot {urdf} has no visual mesh to render. Add <visual> elements.")
        remarks = (*_remarks(files), *_translucent(root))
        if decimation.before > CLUSTERING_RATIO * max_faces:
            remarks = (*remarks, f"{decimation}.")
        return Robot(name, urdf, kinematics, link_names, meshes, decimation, remarks)

    def forward_kinematics(self, joint_positions: Float[Array, "*batch dofs"]) -> Float[Array, "*batch links 4 4"]:
        """Ts_base_link [m] of the links in `link_names` (f_FK of the paper): an array for an array of joint positions,
        a tensor for a tensor, differentiable.

        Raises:
            RobotError: the number of joint positions is wrong.
        """
        return self._kinematics(joint_positions, self.link_names)

    def link_transform(
        self, joint_positions: Float[Array, "*batch dofs"], link_name: str
    ) -> Float[Array, "*batch 4 4"]:
        """T_base_link [m] of any link of the URDF, with or without a mesh.

        Raises:
            RobotError: the number of joint positions is wrong, or the link does not exist.
        """
        return self._kinematics(joint_positions, (link_name,))[..., 0, :, :]

    def joint_index(self, joint_name: str) -> int:
        """Index of a joint in `joint_names`.

        Raises:
            RobotError: the robot does not have this degree of freedom.
        """
        if joint_name not in self.joint_names:
            raise RobotError(
                f"robot {self.name} ({self.urdf}) has no joint {joint_name!r}. "
                f"Its degrees of freedom are: {', '.join(self.joint_names)}."
            )
        return self.joint_names.index(joint_name)


def _mesh_files(root: Element, urdf: Path) -> list[Path]:
    """Existing mesh files of a URDF."""
    meshes = [mesh for visual in root.iterfind("link/visual") for mesh in visual.iterfind("geometry/mesh")]
    return [path for mesh in meshes if is_regular(path := mesh_path(urdf.parent, mesh.get("filename", "")))]


_BESIDE = {".obj": ".mtl", ".gltf": ".bin"}
"""Suffix of a mesh file -> suffix of the materials or buffers in its folder to which it can refer."""


def _cache_key(files: list[Path], kinematics: Kinematics, urdf: Path, limits: tuple[int, float | None]) -> str:
    """Cache key of link meshes; `limits` are `max_faces` and `tolerance` of `Robot.load`."""
    # Units other than metres are part of the key, since older cache entries are not scaled.
    units = tuple(metres for file in files if (metres := collada_asset(file)[0]) != 1.0)
    settings = (kinematics.base_link, *limits, units) if units else (kinematics.base_link, *limits)
    beside = {
        path
        for file in files
        if (suffix := _BESIDE.get(file.suffix.lower()))
        for path in file.parent.glob(f"*{suffix}")
        if is_regular(path) and path.stat().st_size <= MESH.limit
    }
    return mesh_cache.fingerprint([urdf, *files, *sorted(beside)], *settings)


def _remarks(files: Iterable[Path]) -> tuple[str, ...]:
    found: dict[str, list[str]] = {}
    for file in dict.fromkeys(files):
        metres, axis = collada_asset(file)
        if metres != 1.0:
            found.setdefault(f"scaled by the unit of the COLLADA file, {metres:g} m", []).append(file.name)
        if axis not in ("", "Z_UP"):
            text = (
                f"up axis {axis} of the COLLADA file is ignored, as in RViz; rotate the mesh with the URDF's <origin>"
            )
            found.setdefault(text, []).append(file.name)
    return tuple(f"{listed(names, 3)}: {text}." for text, names in found.items())


def _translucent(root: Element) -> tuple[str, ...]:
    """Remark on links with visuals that are omitted since they are translucent."""
    materials = {material.get("name"): material for material in root.findall("material")}

    def omitted(visual: Element) -> bool:
        material = visual.find("material")
        if material is not None and material.find("color") is None:
            material = materials.get(material.get("name"))
        color = None if material is None else material.find("color")
        return color is not None and float(color.get("rgba", "1 1 1 1").split()[3]) < OPAQUE

    names = [link.get("name", "") for link in root.findall("link") if any(map(omitted, link.findall("visual")))]
    if not names:
        return ()
    return (f"{listed(names, 3)}: visuals with an alpha below {OPAQUE:g} are omitted. Set it to 1 to render them.",)


def _prepared_meshes(
    root: Element,
    kinematics: Kinematics,
    urdf: Path,
    link_names: tuple[str, ...],
    limits: tuple[int, float | None],
    report: Callable[[str], None],
) -> mesh_cache.PreparedMeshes:
    """Read and decimate the meshes of links.

    Raises:
        RobotError: a mesh is missing or invalid, or a visual is not readable.
    """
    # Imported for meshes that are not in the cache.
    import yourdfpy  # noqa: PLC0415

    from .meshes import build_link_meshes, load_visual  # noqa: PLC0415

    try:
        model = yourdfpy.URDF.load(
            io.BytesIO(ElementTree.tostring(root)),
            load_meshes=False,
            build_scene_graph=False,
            mesh_dir=str(urdf.parent),
        )
    except Exception as error:  # the parser raises many types of exceptions
        raise RobotError(f"robot {urdf} is not a readable URDF ({error}). Check it with a URDF viewer.") from error
    report(f"{model.robot.name}: preparing meshes (once)")
    materials = {material.name: material for material in model.robot.materials}
    links = {link.name: link for link in model.robot.links}
    parts = [
        (index, mesh, color)
        for index, name in enumerate(link_names)
        for visual in links[name].visuals
        for mesh, color in load_visual(visual, urdf.parent, materials)
    ]
    max_faces, tolerance = limits
    if tolerance is None:
        tolerance = _tolerance(kinematics, link_names, parts)
    meshes, decimation = build_link_meshes(parts, max_faces, tolerance, report)
    if decimation.deviation:
        report(f"{model.robot.name}: {decimation}")
    return meshes, decimation


def _tolerance(
    kinematics: Kinematics, link_names: tuple[str, ...], parts: "list[tuple[int, trimesh.Trimesh, np.ndarray]]"
) -> float:
    """Maximum surface deviation [m]: `INSTRUMENT_TOLERANCE` for an instrument, else a share of the robot's reach."""
    if not parts:
        return INSTRUMENT_TOLERANCE
    longest = max((np.sort(mesh.extents) for _, mesh, _ in parts), key=lambda extents: extents[-1])
    if longest[-2] < SLENDER * longest[-1]:
        return INSTRUMENT_TOLERANCE
    Ts = kinematics(np.zeros(len(kinematics.joint_names)), link_names)
    reach = max(
        np.linalg.norm(mesh.bounding_box.vertices @ Ts[link, :3, :3].T + Ts[link, :3, 3], axis=1).max()
        for link, mesh, _ in parts
    )
    return max(float(reach) * REACH_TOLERANCE, 1e-6)
