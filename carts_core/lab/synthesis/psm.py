"""The shipped robot: a classic da Vinci PSM with a Large Needle Driver, made from dimensions.

`python -m carts_core.lab.synthesis.psm [OUTPUT_DIR]` writes the URDF and its meshes again. Needs the `synthesis` extra.
"""

import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.exchange.ply import export_ply

from ...errors import RobotError
from ...files import output_path, write_bytes, write_text
from ...resources import shipped_robot

try:
    from manifold3d import Manifold

    from . import psm_parts
    from .psm_parts import cylinder
except ImportError as error:
    raise RobotError(
        f"the PSM's meshes need manifold3d ({error}). Install the extra: pip install 'carts[synthesis]'."
    ) from error

ROBOT_NAME = "psm_lnd"
METAL = (0.60, 0.60, 0.60)
CARBIDE = (0.50, 0.50, 0.50)
TUBE = (0.20, 0.20, 0.20)
CABLE = (0.05, 0.05, 0.05)

# Lengths of the classic PSM with this instrument [m], as in the dVRK's published kinematic files.
L_RCC = 0.4318
L_TOOL = 0.4162
L_PITCH_TO_YAW = 0.0091
L_YAW_TO_TIP = 0.0102


@dataclass(frozen=True)
class Row:
    """One row of the modified Denavit-Hartenberg table: Rot_x(alpha) Trans_x(a) Trans_z(d) Rot_z(theta)."""

    joint: str
    """Name of the joint that `theta` or `d` moves; the last row moves with none."""
    kind: str
    """"revolute", "prismatic" or "fixed"."""
    alpha: float
    """[rad]"""
    a: float
    """[m]"""
    d: float
    """Constant part of d [m]."""
    theta: float
    """Constant part of theta [rad]."""
    limits: tuple[float, float] = (0.0, 0.0)
    """[rad] or [m], as in the publicly available URDFs of the dVRK's PSM."""


_RIGHT = np.pi / 2
DH_TABLE = (
    Row("yaw", "revolute", _RIGHT, 0.0, 0.0, _RIGHT, (-1.5707, 1.5707)),
    Row("pitch", "revolute", -_RIGHT, 0.0, 0.0, -_RIGHT, (-0.7854, 0.7854)),
    Row("insertion", "prismatic", _RIGHT, 0.0, -L_RCC, 0.0, (0.0, 0.240)),
    Row("roll", "revolute", 0.0, 0.0, L_TOOL, 0.0, (-4.53786, 4.53786)),
    Row("wrist_pitch", "revolute", -_RIGHT, 0.0, 0.0, -_RIGHT, (-1.39626, 1.39626)),
    Row("wrist_yaw", "revolute", -_RIGHT, L_PITCH_TO_YAW, 0.0, -_RIGHT, (-1.39626, 1.39626)),
    Row("tool_tip", "fixed", -_RIGHT, 0.0, L_YAW_TO_TIP, _RIGHT),
)
JAW_LIMITS = (-0.349066, 1.39626)
"""Opening between the two jaws [rad]; each of them turns by half of it."""


@dataclass(frozen=True)
class Part:
    """One mesh file: a part of a link in one colour."""

    name: str
    link: str
    color: tuple[float, float, float]
    build: Callable[[], Manifold]
    """Makes the solid in the link's frame, in millimetres."""
    keep_rings: bool = False
    """Keep flat neighbouring triangles apart; otherwise they are merged."""


def parts() -> tuple[Part, ...]:
    """Every mesh of the instrument; `jaw_2_link` shares those of `jaw_1_link`."""
    return (
        Part("shaft_tube", "roll_link", TUBE, psm_parts.tube, keep_rings=True),
        Part("shaft_clevis", "roll_link", METAL, psm_parts.clevis),
        Part("shaft_cables", "roll_link", CABLE, psm_parts.shaft_cables),
        Part("wrist_body", "wrist_pitch_link", METAL, psm_parts.wrist_body),
        Part("wrist_cables", "wrist_pitch_link", CABLE, psm_parts.wrist_cables),
        Part("yaw_pin", "wrist_yaw_link", METAL, lambda: cylinder(0.61, -2.84, 2.62, "z", 20)),
        Part("jaw_body", "jaw_1_link", METAL, psm_parts.jaw_body),
        Part("jaw_insert", "jaw_1_link", CARBIDE, psm_parts.insert),
    )


def to_mesh(part: Part) -> trimesh.Trimesh:
    """The part's surface in metres.

    Raises:
        RobotError: the part is empty or not closed, that is, a dimension makes no sense.
    """
    solid = part.build()
    raw = (solid if part.keep_rings else solid.simplify(4e-3)).to_mesh()
    vertices = np.asarray(raw.vert_properties, dtype=float)[:, :3] * 1e-3
    mesh = trimesh.Trimesh(vertices, np.asarray(raw.tri_verts, dtype=int), process=False)
    if not len(mesh.faces) or not mesh.is_watertight:
        raise RobotError(
            f"part {part.name} of the procedural PSM is not a closed solid. Undo the last change of its dimensions."
        )
    # Boolean operations leave slivers below a micrometre, whose normals mean nothing: weld them away.
    mesh.merge_vertices(digits_vertex=6)
    mesh.update_faces(mesh.nondegenerate_faces(height=1e-9))
    mesh.remove_unreferenced_vertices()
    return mesh


def write(folder: Path) -> list[Path]:
    """Write `psm_lnd.urdf` and `meshes/*.ply` into `folder`.

    Returns:
        The written files, the URDF first.

    Raises:
        RobotError: a part is not a closed solid.
    """
    urdf = output_path(folder, f"{ROBOT_NAME}.urdf")
    written = [urdf.path]
    for part in parts():
        path = output_path(folder, "meshes", f"{part.name}.ply")
        write_bytes(path, export_ply(to_mesh(part), encoding="binary", vertex_normal=False))
        written.append(path.path)
    write_text(urdf, urdf_text())
    return written


def urdf_text() -> str:
    """The URDF; every constant rotation is a multiple of 90 degrees, printed with all its digits."""
    lines = [
        '<?xml version="1.0"?>',
        "<!-- Classic da Vinci PSM with a Large Needle Driver, by `python -m carts_core.lab.synthesis.psm`. -->",
        f'<robot name="{ROBOT_NAME}">',
    ]
    lines += [
        f'  <material name="{name}"><color rgba="{_numbers((*color, 1.0))}"/></material>' for name, color in _MATERIALS
    ]
    lines.append('  <link name="base_link"/>')
    parent = "base_link"
    for row in DH_TABLE:
        child = f"{row.joint}_link"
        xyz, rpy = _origin(row)
        lines += _joint(row.joint, row.kind, parent, child, xyz, rpy, row.limits)
        lines += _link(child)
        if row.kind != "fixed":
            parent = child
    lines += _joint("jaw", "revolute", "wrist_yaw_link", "jaw_link", np.zeros(3), np.zeros(3), JAW_LIMITS)
    lines += _link("jaw_link")
    for number, share in ((1, 0.5), (2, -0.5)):
        bound = JAW_LIMITS[1] / 2
        lines += _joint(f"jaw_{number}", "revolute", "wrist_yaw_link", f"jaw_{number}_link", np.zeros(3), np.zeros(3),
                        (-bound, bound), f'<mimic joint="jaw" multiplier="{share}"/>')  # fmt: skip
        lines += _link(f"jaw_{number}_link")
    return "\n".join([*lines, "</robot>", ""])


_MATERIALS = (("metal", METAL), ("carbide", CARBIDE), ("tube", TUBE), ("cable", CABLE))


def _link(name: str) -> list[str]:
    mirrored = name == "jaw_2_link"
    own = [part for part in parts() if part.link == ("jaw_1_link" if mirrored else name)]
    if not own:
        return [f'  <link name="{name}"/>']
    origin = ""
    if mirrored:
        origin = f'<origin xyz="0 0 {psm_parts.OTHER_JAW_SHIFT * 1e-3:g}" rpy="{_numbers((0.0, np.pi, 0.0))}"/>'
    materials = {color: material for material, color in _MATERIALS}
    visuals = [
        f'    <visual>{origin}<geometry><mesh filename="meshes/{part.name}.ply"/></geometry>'
        f'<material name="{materials[part.color]}"/></visual>'
        for part in own
    ]
    return [f'  <link name="{name}">', *visuals, "  </link>"]


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Float[np.ndarray, "3"],
    rpy: Float[np.ndarray, "3"],
    limits: tuple[float, float],
    extra: str = "",
) -> list[str]:
    inner = [f'<parent link="{parent}"/>', f'<child link="{child}"/>',
             f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>']  # fmt: skip
    if kind != "fixed":
        inner.append('<axis xyz="0 0 1"/>')
        inner.append(f'<limit lower="{limits[0]!r}" upper="{limits[1]!r}" effort="1000" velocity="0.4"/>')
    if extra:
        inner.append(extra)
    return [f'  <joint name="{name}" type="{kind}">', *(f"    {line}" for line in inner), "  </joint>"]


def dh_transform(row: Row, position: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """T_previous_row of one DH row at a joint position [rad] or [m], in double precision."""
    d = row.d + (position if row.kind == "prismatic" else 0.0)
    theta = row.theta + (position if row.kind == "revolute" else 0.0)
    T_previous_row = np.eye(4)
    T_previous_row[:3, :3] = _rotation(0, row.alpha) @ _rotation(2, theta)
    T_previous_row[:3, 3] = np.array([row.a, 0.0, 0.0]) + _rotation(0, row.alpha) @ np.array([0.0, 0.0, d])
    return T_previous_row


def _origin(row: Row) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """xyz [m] and rpy [rad] of a DH row at joint position zero; URDF has no Denavit-Hartenberg."""
    T_previous_row = dh_transform(row)
    quarter_turns = (0.0, _RIGHT, -_RIGHT, np.pi)
    for roll, pitch, yaw in itertools.product(quarter_turns, repeat=3):
        rotation = _rotation(2, yaw) @ _rotation(1, pitch) @ _rotation(0, roll)
        if np.allclose(rotation, T_previous_row[:3, :3], atol=1e-12):
            return np.round(T_previous_row[:3, 3], 9) + 0.0, np.array([roll, pitch, yaw])
    raise RobotError(f"DH row {row.joint} is not turned by multiples of 90 degrees. Correct the table in psm.py.")


def _rotation(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = np.cos(angle)
    rotation[j, i] = np.sin(angle)
    rotation[i, j] = -rotation[j, i]
    return rotation


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    # repr keeps every digit of pi / 2; whole numbers are printed short.
    return " ".join(f"{value:g}" if value == int(value) else repr(value) for value in map(float, values))


if __name__ == "__main__":
    for path in write(Path(sys.argv[1]) if len(sys.argv) > 1 else shipped_robot().parent):
        print(path)
