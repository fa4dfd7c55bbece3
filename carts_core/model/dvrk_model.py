"""Robots from the dVRK's model tree (jhu-dvrk/dvrk_model): an arm with one of its instruments as a plain URDF.

The tree consists of xacro files for ROS, which are expanded without ROS. Links before the instrument's shaft are
omitted, since they are not visible in an endoscope. The three joints that carry the shaft are those of the dVRK's
controller, as in recordings; the tree's linkage of the Si arm, made for visualization, is pitched by 9.3 degrees
relative to these.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from ..errors import RobotError
from ..files.decoding import decoded
from ..files.reading import CALIBRATION, MESH, LfsPointerError, open_regular, parse_yaml, read_text
from ..package_imports import require_package
from ..wording import counted
from .link_mesh import mesh_path
from .psm_kinematics import CLASSIC, SI
from .psm_urdf import remote_center_chain
from .xacro_guard import expanded

PACKAGE = "dvrk_model"
_PREFIX = "PSM1_"
_FIRST_SEEN = "roll_link"
"""First link that can be in view."""
_CARRIED_BY = "insertion_link"
_TABLE = Path("urdf/common/instruments/instruments.yaml")


@dataclass(frozen=True)
class Instrument:
    """Instrument in the model tree."""

    number: str
    """Last six digits of the model number, such as `420093`."""
    name: str
    generation: str
    """Generation of the arm: `Classic` or `Si`."""
    tip: str
    """Number of the tip, such as `093`."""
    has_tip: bool
    """Whether the tree has the meshes of the tip; otherwise it has boxes of 5 mm."""


def list_instruments(model: Path) -> dict[str, Instrument]:
    """Instruments of a model tree, by number.

    Raises:
        RobotError: the folder is not a model tree.
    """
    table = model / _TABLE
    if not table.is_file():
        raise RobotError(
            f"{model} is not a checkout of dvrk_model: {_TABLE} is missing. Give the folder that contains "
            "`urdf` and `meshes` (https://github.com/jhu-dvrk/dvrk_model)."
        )
    try:
        entries = parse_yaml(read_text(table, CALIBRATION))["instruments"]
        return {
            str(number): Instrument(
                str(number),
                str(entry["name"]),
                str(entry["housing"]),
                str(entry["tip"]).zfill(3),
                (table.parent / "tip" / f"tip_{str(entry['tip']).zfill(3)}.urdf.xacro").is_file(),
            )
            for number, entry in entries.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RobotError(
            f"{table} is not a table of instruments ({error!r}). Repeat the checkout of dvrk_model."
        ) from error


def choose_instrument(model: Path, number: str) -> Instrument:
    """Find an instrument by its number.

    Raises:
        RobotError: the checkout does not list the instrument, or lacks the meshes of its tip.
    """
    instruments = list_instruments(model)
    if number not in instruments:
        raise RobotError(
            f"instrument {number!r} is not in {model / _TABLE}. It contains: {', '.join(sorted(instruments))}. "
            "Numbers have six digits and begin with 400 (classic arm) or 420 (Si)."
        )
    chosen = instruments[number]
    if not chosen.has_tip:
        others = ", ".join(f"{key} ({other.name})" for key, other in instruments.items() if other.has_tip)
        raise RobotError(
            f"instrument {number} ({chosen.name}) has no tip meshes in {model}, only 5 mm boxes, which do not resemble "
            f"the instrument. Instruments with meshes: {others}."
        )
    return chosen


def dvrk_urdf(model: Path, number: str, folder: Path) -> str:
    """Create the URDF of an arm with an instrument, for a file in `folder`.

    The root is the DH base of the arm, at the remote centre; joints are named as in the sequence format.

    Args:
        folder: folder of the URDF, to which mesh paths are relative; meshes are not copied.

    Raises:
        RobotError: the tree or the instrument is not usable, or a mesh is missing or was not fetched by Git LFS.
    """
    chosen = choose_instrument(model, number)
    root = ElementTree.fromstring(_expanded(model, chosen))
    root.set("name", f"psm_{chosen.generation.lower()}_{number}")
    for element in root.iter():
        for key in ("name", "link"):
            if element.tag in ("link", "parent", "child") and key in element.attrib:
                element.set(key, element.attrib[key].removeprefix(_PREFIX))
    _keep_what_is_seen(root)
    for position, element in enumerate(remote_center_chain(CLASSIC if chosen.generation == "Classic" else SI)):
        root.insert(position, element)
    _relocate_meshes(root, model, folder)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _expanded(model: Path, chosen: Instrument) -> str:
    require_package("xacrodoc", "import")
    arm = model / "urdf" / chosen.generation / "PSM1.urdf.xacro"
    options = {"instrument": chosen.number, "show_rcm": "false", "is_virtual": "true"}
    try:
        return decoded(expanded, arm, {PACKAGE: str(model.resolve())}, options)
    except (OSError, ValueError, RobotError) as error:
        raise RobotError(
            f"{arm} cannot be expanded for instrument {chosen.number} ({error}). Repeat the checkout of dvrk_model."
        ) from error


def _keep_what_is_seen(root: ElementTree.Element) -> None:
    """Keep only the links from the shaft on, with their joints and visuals."""
    joints = {_link(joint, "child"): joint for joint in root.findall("joint")}
    if _FIRST_SEEN not in joints:
        raise RobotError(
            f"the model has no link {_FIRST_SEEN!r}, the first link of the instrument. Use dvrk_model 2.5."
        )
    for link in root.findall("link"):
        name = link.get("name", "")
        if not _is_below(name, joints):
            root.remove(link)
            if name in joints:
                root.remove(joints[name])
        for part in list(link):
            # Boxes are placeholders for missing meshes.
            if part.tag != "visual" or part.find("geometry/box") is not None:
                link.remove(part)
    for parent in joints[_FIRST_SEEN].iter("parent"):
        parent.set("link", _CARRIED_BY)


def _is_below(link: str, joints: Mapping[str, ElementTree.Element]) -> bool:
    while link != _FIRST_SEEN:
        if link not in joints:
            return False
        link = _link(joints[link], "parent")
    return True


def _link(joint: ElementTree.Element, role: str) -> str:
    element = joint.find(role)
    return "" if element is None else element.get("link", "")


def _relocate_meshes(root: ElementTree.Element, model: Path, folder: Path) -> None:
    missing, pointers = [], []
    for mesh in root.iter("mesh"):
        path = mesh_path((model / "urdf").resolve(), mesh.get("filename", ""))
        if not path.is_file():
            missing.append(mesh.get("filename", "").removeprefix(f"package://{PACKAGE}/"))
        elif _is_pointer(path):
            pointers.append(str(path))
        mesh.set("filename", Path(os.path.relpath(path, folder.resolve())).as_posix())
    if pointers:
        raise RobotError(
            f"{counted(len(pointers), 'file')} in {model} are Git LFS pointers without meshes: {', '.join(pointers)}. "
            f"Fetch them: git -C {model} lfs pull."
        )
    if missing:
        raise RobotError(f"{model} lacks meshes of this instrument: {', '.join(missing)}. Repeat the checkout.")


def _is_pointer(path: Path) -> bool:
    try:
        open_regular(path, MESH).close()
    except LfsPointerError:
        return True
    return False
