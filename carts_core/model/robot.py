"""A robot: degrees of freedom, forward kinematics and the meshes of its links, from any URDF."""

import io
from collections.abc import Callable, Iterable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
import trimesh
import yourdfpy
from jaxtyping import Float
from torch import Tensor

from ..errors import RobotError
from ..files.reading import ROBOT, is_regular, read_text
from ..wording import listed
from . import mesh_cache
from .instruments import robot_file
from .kinematics import Kinematics, exact_right_angles
from .mesh_files import collada_asset, mesh_path
from .meshes import MOST_KEPT, Decimation, LinkMesh, build_link_meshes, load_visual
from .urdf_check import parsed_urdf

INSTRUMENT_TOLERANCE = 2e-4
"""How far decimation may move surfaces of an instrument [m]."""
REACH_TOLERANCE = 1e-3
"""The same for other robots, a part of their reach [1]."""
SLENDER = 0.1
"""Largest width of a shaft, in lengths [1]."""


class Robot:
    """An articulated robot as the scene sees it. Made by `Robot.load`.

    Attributes:
        name: the URDF's robot name.
        urdf: path of the URDF.
        base_link: link whose frame link transforms are given in.
        joint_names: independent degrees of freedom; a mimic joint counts to the joint that it follows.
        joint_types: "revolute" or "prismatic", per degree of freedom.
        joint_limits: lower and upper limit per degree of freedom [dofs, 2], [rad] or [m], infinite where not given.
        link_names: the links that carry a visual mesh.
        meshes: parts of these links; `LinkMesh.link` indexes `link_names`.
        decimation: how many triangles were taken away, and how far surfaces moved.
        remarks: sentences on what is changed about the files' meshes: scaled by their unit, simplified further than
            asked for; and on up axes, which are not applied.
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
        self.link_names = link_names
        self.meshes = meshes
        self.decimation = decimation
        self.remarks = remarks
        self._kinematics = kinematics

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
        """Read a URDF and its visual meshes; decimated meshes come from the cache the second time.

        Args:
            urdf: path of the URDF, mesh paths are relative to it; or `builtin:NAME`.
            base_link: frame of the link transforms, the URDF's root by default.
            max_faces: a robot with so many triangles is left as it is; those of others are decimated.
            tolerance: how far decimation may move surfaces [m]; by default 0.2 mm for an instrument, which has a
                slender shaft, and a thousandth of the reach for other robots.
            progress: called with a line for people, now and then.

        Raises:
            RobotError: the URDF or one of its meshes is missing or broken, or `base_link` is not in it.
        """
        # Resolved once, here: what is found beside the URDF stays found when the working directory changes.
        urdf = robot_file(urdf).absolute()
        report = progress or (lambda line: None)
        try:
            root = parsed_urdf(read_text(urdf, ROBOT), urdf)
            exact_right_angles(root)
            text = ElementTree.tostring(root, encoding="unicode")
            model = yourdfpy.URDF.load(
                io.BytesIO(text.encode()), load_meshes=False, build_scene_graph=False, mesh_dir=str(urdf.parent)
            )
            kinematics = Kinematics(model, text, base_link, urdf)
        except FileNotFoundError as error:
            raise RobotError(f"robot {urdf} is missing. Give the path of a URDF file.") from error
        except RobotError:
            raise
        except Exception as error:  # the URDF parser raises many kinds
            raise RobotError(f"robot {urdf} is not a readable URDF ({error}). Check it with a URDF viewer.") from error
        if not kinematics.joint_names:
            raise RobotError(f"robot {model.robot.name} ({urdf}) has no joint that moves. Name a robot that has one.")
        link_names = tuple(link.name for link in model.robot.links if link.visuals)
        limits = max_faces, tolerance
        meshes, decimation = mesh_cache.kept(
            _cache_key(model, kinematics, urdf, limits),
            lambda: _prepared_meshes(model, kinematics, urdf, link_names, limits, report),
        )
        if not meshes:
            raise RobotError(f"robot {urdf} has no visual mesh, so there is nothing to render. Add <visual> elements.")
        remarks = _remarks(_mesh_files(model, urdf))
        if decimation.before > MOST_KEPT * max_faces:
            remarks = (*remarks, f"{decimation}.")
        return Robot(model.robot.name, urdf, kinematics, link_names, meshes, decimation, remarks)

    def forward_kinematics(self, joint_positions: Float[Tensor, "*batch dofs"]) -> Float[Tensor, "*batch links 4 4"]:
        """Ts_base_link [m] of the links in `link_names`, differentiable (f_FK of the paper).

        Raises:
            RobotError: wrong number of joint positions.
        """
        return self._kinematics(joint_positions, self.link_names)

    def link_transform(
        self, joint_positions: Float[Tensor, "*batch dofs"], link_name: str
    ) -> Float[Tensor, "*batch 4 4"]:
        """T_base_link [m] of any link of the URDF, with or without a mesh.

        Raises:
            RobotError: wrong number of joint positions, or no such link.
        """
        return self._kinematics(joint_positions, (link_name,))[..., 0, :, :]

    def joint_index(self, joint_name: str) -> int:
        """Position of a joint in `joint_names`.

        Raises:
            RobotError: the robot has no such degree of freedom.
        """
        if joint_name not in self.joint_names:
            raise RobotError(
                f"robot {self.name} ({self.urdf}) has no joint {joint_name!r}. "
                f"Its degrees of freedom are: {', '.join(self.joint_names)}."
            )
        return self.joint_names.index(joint_name)


def _mesh_files(model: yourdfpy.URDF, urdf: Path) -> list[Path]:
    """The mesh files of a URDF that are there."""
    geometries = [visual.geometry for link in model.robot.links for visual in link.visuals]
    names = [each.mesh.filename for each in geometries if each is not None and each.mesh is not None]
    return [path for name in names if is_regular(path := mesh_path(urdf.parent, name))]


def _cache_key(model: yourdfpy.URDF, kinematics: Kinematics, urdf: Path, limits: tuple[int, float | None]) -> str:
    """What link meshes are made from; `limits` are `max_faces` and `tolerance` of `Robot.load`."""
    files = _mesh_files(model, urdf)
    # Meshes in units other than metres were not scaled before.
    units = tuple(metres for file in files if (metres := collada_asset(file)[0]) != 1.0)
    settings = (kinematics.base_link, *limits, units) if units else (kinematics.base_link, *limits)
    return mesh_cache.fingerprint([urdf, *files], *settings)


def _remarks(files: Iterable[Path]) -> tuple[str, ...]:
    found: dict[str, list[str]] = {}
    for file in dict.fromkeys(files):
        metres, axis = collada_asset(file)
        if metres != 1.0:
            found.setdefault(f"scaled by the unit of the COLLADA file, {metres:g} m", []).append(file.name)
        if axis not in ("", "Z_UP"):
            text = (
                f"up axis {axis} of the COLLADA file is not applied, as in RViz; turn the mesh by the URDF's <origin>"
            )
            found.setdefault(text, []).append(file.name)
    return tuple(f"{listed(names, 3)}: {text}." for text, names in found.items())


def _prepared_meshes(
    model: yourdfpy.URDF,
    kinematics: Kinematics,
    urdf: Path,
    link_names: tuple[str, ...],
    limits: tuple[int, float | None],
    report: Callable[[str], None],
) -> mesh_cache.Made:
    """Meshes of links from their files, decimated."""
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
    kinematics: Kinematics, link_names: tuple[str, ...], parts: list[tuple[int, trimesh.Trimesh, np.ndarray]]
) -> float:
    """How far surfaces may move [m]: what an endoscope's image cannot show, or little of a robot's reach."""
    if not parts:
        return INSTRUMENT_TOLERANCE
    longest = max((np.sort(mesh.extents) for _, mesh, _ in parts), key=lambda extents: extents[-1])
    if longest[-2] < SLENDER * longest[-1]:
        return INSTRUMENT_TOLERANCE
    rest = torch.zeros(len(kinematics.joint_names), dtype=torch.float64)
    Ts = kinematics(rest, link_names).numpy()
    reach = max(
        np.linalg.norm(mesh.bounding_box.vertices @ Ts[link, :3, :3].T + Ts[link, :3, 3], axis=1).max()
        for link, mesh, _ in parts
    )
    return max(float(reach) * REACH_TOLERANCE, 1e-6)
