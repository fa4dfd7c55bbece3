"""A robot: degrees of freedom, forward kinematics and the meshes of its links, from any URDF."""

from collections.abc import Callable
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from ..errors import RobotError
from ..files.reading import ROBOT, is_regular, read_text
from . import mesh_cache
from .instruments import robot_file
from .kinematics import Kinematics, exact_right_angles
from .mesh_paths import mesh_path
from .meshes import Decimation, LinkMesh
from .urdf import MeshFile, Urdf, read_urdf
from .urdf_check import parsed_urdf


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
    """

    def __init__(
        self,
        name: str,
        urdf: Path,
        kinematics: Kinematics,
        link_names: tuple[str, ...],
        meshes: tuple[LinkMesh, ...],
        decimation: Decimation,
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
            model = read_urdf(root)
            kinematics = Kinematics(model, base_link, urdf)
        except FileNotFoundError as error:
            raise RobotError(f"robot {urdf} is missing. Give the path of a URDF file.") from error
        except RobotError:
            raise
        except (OSError, ValueError, KeyError) as error:
            raise RobotError(f"robot {urdf} is not a readable URDF ({error}). Check it with a URDF viewer.") from error
        if not kinematics.joint_names:
            raise RobotError(f"robot {model.name} ({urdf}) has no joint that moves. Name a robot that has one.")
        link_names = tuple(link.name for link in model.links if link.visuals)
        meshes, decimation = _load_meshes(model, kinematics, urdf, link_names, (max_faces, tolerance), report)
        if not meshes:
            raise RobotError(f"robot {urdf} has no visual mesh, so there is nothing to render. Add <visual> elements.")
        return Robot(model.name, urdf, kinematics, link_names, meshes, decimation)

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


def _load_meshes(
    model: Urdf,
    kinematics: Kinematics,
    urdf: Path,
    link_names: tuple[str, ...],
    limits: tuple[int, float | None],
    report: Callable[[str], None],
) -> tuple[tuple[LinkMesh, ...], Decimation]:
    """Meshes of links; `limits` are `max_faces` and `tolerance` of `Robot.load`."""
    mesh_files = [
        mesh_path(urdf.parent, visual.shape.name)
        for link in model.links
        for visual in link.visuals
        if isinstance(visual.shape, MeshFile)
    ]
    key = mesh_cache.fingerprint([urdf, *filter(is_regular, mesh_files)], kinematics.base_link, *limits)
    if (cached := mesh_cache.read(key)) is not None:
        return cached
    # Of many processes that open a robot at once, as in a batch, one decimates, and the others have what it made.
    with mesh_cache.one_process():
        if (cached := mesh_cache.read(key)) is not None:
            return cached
        # What reads meshes takes half a second to import.
        from .mesh_building import prepared_meshes  # noqa: PLC0415

        made = prepared_meshes(model, kinematics, urdf.parent, link_names, limits, report)
        mesh_cache.write(key, *made)
        return made
