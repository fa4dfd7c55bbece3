"""What a URDF must satisfy before any library reads it: well-formed XML, one tree of links, and finite numbers."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from ..errors import RobotError
from ..wording import listed, shown

_MOST_ELEMENTS = 100_000
_MOST_LINKS = 1_000
_DEEPEST = 32
_FARTHEST = 1e3
"""Largest coordinate, size or angle of a robot [m], [rad]."""
_LARGEST_FACTOR = 1e6
"""Largest scale of a mesh and factor of a mimic joint; the smallest is its inverse."""
_SHORTEST_AXIS = 1e-6
_TYPES = ("revolute", "continuous", "prismatic", "fixed")
_XACRO = "ros.org/wiki/xacro}"


def parsed_urdf(text: str, source: Path) -> Element:
    """The root of a URDF's elements, checked.

    Args:
        text: of the file.
        source: the file, for errors.

    Raises:
        RobotError: it is no URDF, links and joints are not one tree, or a number is not finite or impossible.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise RobotError(f"robot {source} declares a document type or entities, which no URDF needs. Remove them.")
    if text.count("<") > 2 * _MOST_ELEMENTS:
        raise RobotError(
            f"robot {source} has more than {_MOST_ELEMENTS:,} elements. Export it without what is not drawn."
        )
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
    if level or count > _MOST_ELEMENTS:
        raise RobotError(f"robot {source} is nested more than {_DEEPEST} deep or has more than {_MOST_ELEMENTS} parts.")


def _check_tree(root: Element, source: Path) -> None:
    """Check that names are unique, and that joints make one tree of all links."""
    links, joints = root.findall("link"), root.findall("joint")
    if not 1 <= len(links) <= _MOST_LINKS or len(joints) > _MOST_LINKS:
        raise RobotError(f"robot {source} has {len(links)} links; allowed are 1 to {_MOST_LINKS}.")
    for kind, elements in (("link", links), ("joint", joints)):
        counts = Counter(element.get("name", "") for element in elements)
        if wrong := [name for name, count in counts.items() if count > 1 or not name]:
            raise RobotError(
                f"robot {source}: every {kind} needs a name of its own, but {listed(map(repr, wrong))} is not one."
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
        raise RobotError(f"robot {source} has {found}. Joints must make one tree of all its links.")
    # As many joints as links below the root, and each reaches the root: then there is no loop.
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
            f"robot {source}: joint {joint.get('name')!r} names the {role} link {name!r}, which is not there. "
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
            _number(mimic, "multiplier", source, _LARGEST_FACTOR)
            _number(mimic, "offset", source)
            if mimic.get("joint") not in moving:
                raise RobotError(f"robot {source}: joint {name!r} mimics {mimic.get('joint')!r}, which does not move.")
            mimic = moving[mimic.get("joint")]
        else:
            raise RobotError(f"robot {source}: joint {name!r} mimics, in the end, itself. Name a joint that moves.")


def _check_joint(joint: Element, source: Path) -> None:
    name, kind = joint.get("name"), joint.get("type")
    if kind not in _TYPES:
        raise RobotError(f"robot {source}: joint {name!r} is of type {kind!r}; allowed are {', '.join(_TYPES)}.")
    if (axis := joint.find("axis")) is not None and (values := _vector(axis, "xyz", 3, source)):
        if kind != "fixed" and math.hypot(*values) < _SHORTEST_AXIS:
            raise RobotError(f"robot {source}: the axis of joint {name!r} has no direction: {axis.get('xyz')!r}.")
    if (limit := joint.find("limit")) is not None:
        lower, upper = (_number(limit, key, source, math.inf) for key in ("lower", "upper"))
        if kind in ("revolute", "prismatic") and (lower or 0.0) > (upper or 0.0):
            raise RobotError(f"robot {source}: joint {name!r} has the lower limit {lower} above the upper one {upper}.")


def _check_geometry(geometry: Element, source: Path) -> None:
    for shape in geometry:
        if shape.tag == "mesh":
            if not shape.get("filename"):
                raise RobotError(f'robot {source}: a <mesh> has no file name. Give one, say filename="link.stl".')
            scale = _floats(shape, "scale", source)
            if scale and (len(scale) not in (1, 3) or not all(_is_factor(value) for value in scale)):
                raise _wrong(shape, "scale", source, "one or three factors other than 0, within a million")
        for key, count in (("size", 3), ("radius", 1), ("length", 1)):
            _vector(shape, key, count, source, smallest=1 / _LARGEST_FACTOR)


def _is_factor(value: float) -> bool:
    return 1 / _LARGEST_FACTOR <= abs(value) <= _LARGEST_FACTOR


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
    """The numbers of an attribute, none where it is absent."""
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
