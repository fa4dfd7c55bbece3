"""`builtin:NAME`: the shipped robot and the built-in instruments as URDFs with meshes.

Meshes are generated on demand and cached. The shaft, and the wrist and jaws of the Large Needle Driver, are those of
the shipped robot.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

from ...errors import OutputError, RobotError
from ...files import output_path, write_bytes
from ...files.reading import MESH, is_regular, read_bytes
from ...resources import shipped_robot
from ...wording import closest, shown
from ..mesh_cache import cache_dir
from ..psm_kinematics import CLASSIC, SI, PsmGeometry
from ..psm_urdf import joint, remote_center_chain, right_angle_rpy
from .catalogue import BY_NAME, SI_SUFFIX, Instrument
from .shapes import CHEEK_OUTSIDE, FIRST, SECOND, Electrode, Jaws, Solid, cylinder, wide_body, wide_cables

SCHEME = "builtin:"
SHIPPED = "psm_lnd"
"""Name of the robot whose files are shipped."""

METAL, CARBIDE, TUBE, CABLE, COLLAR = "metal", "carbide", "tube", "cable", "collar"
_COLORS = {METAL: 0.60, CARBIDE: 0.50, TUBE: 0.20, CABLE: 0.05, COLLAR: 0.35}
_SLIM_WRIST = 9.1
_JAW_LOWEST = -0.349066
"""Lower limit of the jaw angle [rad], which is measured as negative while grasping."""
_TURNED_JAW = 'xyz="0 0 -2.5e-05" rpy="0 3.141592653589793 0"'
"""Pose of the first jaw's mesh in the second jaw of the shipped robot."""


def builtin_names() -> tuple[str, ...]:
    """Names of the built-in robots."""
    return (SHIPPED, *(name + suffix for name in BY_NAME for suffix in ("", SI_SUFFIX)))


def robot_file(robot: Path | str) -> Path:
    """URDF file of a robot given as a path or as `builtin:NAME`.

    Raises:
        RobotError: there is no built-in robot of that name.
    """
    name = str(robot)
    return builtin_urdf(name.removeprefix(SCHEME)) if name.startswith(SCHEME) else Path(robot)


@cache
def builtin_urdf(name: str) -> Path:
    """URDF file of a built-in robot. The files are generated in the cache, and differing files are replaced.

    Raises:
        RobotError: there is no such robot.
    """
    if name == SHIPPED:
        return shipped_robot()
    if name not in builtin_names():
        meant = closest(SCHEME + name, [SCHEME + known for known in builtin_names()])
        raise RobotError(f"there is no robot {shown(SCHEME + name)}.{meant} `carts robots` lists the built-in robots.")
    folder = cache_dir() / "instruments" / name
    try:
        return _written(name, folder)
    except OutputError:
        # An unwritable cache is not an error.
        return _written(name, Path(_scratch().name) / name)


@cache
def _scratch() -> TemporaryDirectory:
    """Temporary folder that is removed when the program ends."""
    return TemporaryDirectory(prefix="carts-")


def instrument_of(name: str) -> tuple[Instrument, PsmGeometry]:
    """Instrument and arm geometry of a built-in robot other than the shipped one."""
    si = name.endswith(SI_SUFFIX)
    instrument = BY_NAME[name.removesuffix(SI_SUFFIX)]
    arm = SI if si else CLASSIC
    return instrument, PsmGeometry(arm.shaft_length, instrument.wrist_length * 1e-3, arm.remote_center, arm.limits)


def _written(name: str, folder: Path) -> Path:
    instrument, geometry = instrument_of(name)
    files = {f"meshes/{part}.ply": content for part, content in _meshes(instrument).items()}
    files[f"{name}.urdf"] = _urdf(name, instrument, geometry).encode()
    for file, content in files.items():
        path = folder / file
        if not (is_regular(path) and read_bytes(path, MESH) == content):
            write_bytes(output_path(folder, *file.split("/")), content)
    return folder / f"{name}.urdf"


def _parts(instrument: Instrument) -> Iterator[tuple[str, str, str, str | Solid]]:
    """Name, link, material and shape of every mesh; a shape is the name of a shipped file, or a solid."""
    yield "shaft_tube", "roll_link", TUBE, "shaft_tube"
    yield "shaft_clevis", "roll_link", METAL, "shaft_clevis"
    yield "shaft_cables", "roll_link", CABLE, "shaft_cables"
    if instrument.wrist_length == _SLIM_WRIST:
        yield "wrist_body", "wrist_pitch_link", METAL, "wrist_body"
        yield "wrist_cables", "wrist_pitch_link", CABLE, "wrist_cables"
        yield "yaw_pin", "wrist_yaw_link", METAL, "yaw_pin"
    else:
        yield "wrist_body", "wrist_pitch_link", METAL, wide_body(instrument.wrist_length)
        yield "wrist_cables", "wrist_pitch_link", CABLE, wide_cables(instrument.wrist_length)
        yield "yaw_pin", "wrist_yaw_link", METAL, cylinder(0.85, -CHEEK_OUTSIDE, CHEEK_OUTSIDE, "z", 18)
    tip = instrument.tip
    if tip is None:
        yield "jaw_1_body", "jaw_1_link", METAL, "jaw_body"
        yield "jaw_1_insert", "jaw_1_link", CARBIDE, "jaw_insert"
        yield "jaw_2_body", "jaw_2_link", METAL, "jaw_body"
        yield "jaw_2_insert", "jaw_2_link", CARBIDE, "jaw_insert"
    elif isinstance(tip, Electrode):
        yield "tip_body", "jaw_link", COLLAR, tip.body()
        yield "tip_electrode", "jaw_link", METAL, tip.electrode()
    else:
        if isinstance(tip, Jaws) and (base := tip.base()) is not None:
            yield "tip_base", "wrist_yaw_link", METAL, base
        for number, side in ((1, FIRST), (2, SECOND)):
            yield f"jaw_{number}_body", f"jaw_{number}_link", METAL, tip.jaw(side)
            if (insert := tip.inserted(side)) is not None:
                yield f"jaw_{number}_insert", f"jaw_{number}_link", CARBIDE, insert


def _meshes(instrument: Instrument) -> dict[str, bytes]:
    import trimesh  # noqa: PLC0415
    from trimesh.exchange.ply import export_ply  # noqa: PLC0415

    made = {}
    for name, _, _, shape in _parts(instrument):
        if isinstance(shape, str):
            made[name] = read_bytes(shipped_robot().parent / "meshes" / f"{shape}.ply", MESH)
        else:
            mesh = trimesh.Trimesh(shape.vertices * 1e-3, shape.faces, process=False)
            made[name] = export_ply(mesh, encoding="binary", vertex_normal=False)
    return made


def _urdf(name: str, instrument: Instrument, geometry: PsmGeometry) -> str:
    root = ElementTree.Element("robot", name=name)
    for material, grey in _COLORS.items():
        color = ElementTree.SubElement(ElementTree.SubElement(root, "material", name=material), "color")
        color.set("rgba", f"{grey} {grey} {grey} 1")
    root.extend(remote_center_chain(geometry))
    root.extend(_wrist_joints(geometry))
    tip_end = f"0 {instrument.length * 1e-3:.6g} 0"
    if instrument.has_jaws:
        root.extend(_jaw_joints(instrument))
    else:
        root.append(joint("jaw", "fixed", "wrist_yaw_link", "jaw_link"))
    root.append(joint("tool_tip", "fixed", "wrist_yaw_link", "tool_tip_link", tip_end, right_angle_rpy(0, 1, 1)))
    visuals: dict[str, list[ElementTree.Element]] = {}
    for part, link, material, shape in _parts(instrument):
        visual = ElementTree.Element("visual")
        if link == "jaw_2_link" and isinstance(shape, str):
            visual.append(ElementTree.fromstring(f"<origin {_TURNED_JAW}/>"))
        mesh = ElementTree.SubElement(ElementTree.SubElement(visual, "geometry"), "mesh")
        mesh.set("filename", f"meshes/{part}.ply")
        ElementTree.SubElement(visual, "material", name=material)
        visuals.setdefault(link, []).append(visual)
    present = {link.get("name") for link in root.findall("link")}
    for element in root.findall("joint/child"):
        if (child := element.get("link", "")) not in present:
            ElementTree.SubElement(root, "link", name=child).extend(visuals.get(child, []))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _wrist_joints(geometry: PsmGeometry) -> Iterator[ElementTree.Element]:
    """Joints from the instrument's base to the link that carries the jaws."""
    roll, pitch, yaw = geometry.limits[3:]
    turn = right_angle_rpy(0, -1, -1)
    along = f"{geometry.wrist_length:.6g} 0 0"
    yield joint("roll", "revolute", "insertion_link", "roll_link", f"0 0 {geometry.shaft_length}", "0 0 0", roll)
    yield joint("wrist_pitch", "revolute", "roll_link", "wrist_pitch_link", "0 0 0", turn, pitch)
    yield joint("wrist_yaw", "revolute", "wrist_pitch_link", "wrist_yaw_link", along, turn, yaw)


def _jaw_joints(instrument: Instrument) -> Iterator[ElementTree.Element]:
    limits = (_JAW_LOWEST, instrument.opening)
    pivot = getattr(instrument.tip, "pivot", 0.0) * 1e-3
    yield joint("jaw", "revolute", "wrist_yaw_link", "jaw_link", limits=limits)
    for number, share in ((1, 0.5), (2, -0.5)):
        half = (-instrument.opening / 2, instrument.opening / 2)
        element = joint(
            f"jaw_{number}", "revolute", "wrist_yaw_link", f"jaw_{number}_link", f"0 {pivot:.6g} 0", limits=half
        )
        ElementTree.SubElement(element, "mimic", joint="jaw", multiplier=str(share))
        yield element
