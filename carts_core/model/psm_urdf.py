"""Common part of the URDFs of PSMs: links and joints from the remote centre of motion to the instrument's base."""

import math
from collections.abc import Iterator
from xml.etree import ElementTree

from .psm_kinematics import PsmGeometry


def right_angle_rpy(roll: int, pitch: int, yaw: int) -> str:
    """URDF attribute `rpy` of a rotation by multiples of 90 degrees, in full precision."""
    return " ".join("0" if turns == 0 else repr(turns * math.pi / 2) for turns in (roll, pitch, yaw))


def joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: str = "0 0 0",
    rpy: str = "0 0 0",
    limits: tuple[float, float] | None = None,
) -> ElementTree.Element:
    """Create a URDF joint about or along the z axis of its child."""
    element = ElementTree.Element("joint", name=name, type=kind)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)
    if limits is not None:
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        ElementTree.SubElement(
            element, "limit", lower=str(limits[0]), upper=str(limits[1]), effort="1000", velocity="0.4"
        )
    return element


def remote_center_chain(geometry: PsmGeometry) -> Iterator[ElementTree.Element]:
    """Links and joints from the remote centre of motion to the instrument's base, as in the dVRK's controller."""
    places = (
        ("yaw", "revolute", "0 0 0", right_angle_rpy(0, -1, 1)),
        ("pitch", "revolute", "0 0 0", right_angle_rpy(0, -1, -1)),
        ("insertion", "prismatic", f"0 {geometry.remote_center} 0", right_angle_rpy(1, 0, 0)),
    )
    parent = "base_link"
    yield ElementTree.Element("link", name=parent)
    for (name, kind, xyz, rpy), limits in zip(places, geometry.limits, strict=False):
        child = f"{name}_link"
        yield joint(name, kind, parent, child, xyz, rpy, limits)
        yield ElementTree.Element("link", name=child)
        parent = child
