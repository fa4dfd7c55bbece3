"""Forward kinematics of a URDF tree, differentiable and batched (pytorch-kinematics)."""

import copy
import math
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import torch
import yourdfpy
from jaxtyping import Float
from torch import Tensor

from ..errors import RobotError
from ..imports import deferred
from ..wording import listed, shown

with deferred("matplotlib", "pyplot"):  # needed only to plot its solvers; 0.2 s
    import pytorch_kinematics

NO_LIMIT = 1e3
"""Joint limit [rad], [m] above which a joint counts as unlimited."""
_JOINT_PARTS = ("parent", "child", "origin", "axis", "mimic")
"""Elements of a joint that define its motion; limits and dynamics have required attributes that many URDFs omit."""
ROUND_OFF = 1e-5
"""Distance [rad] below which angles are set to a multiple of 90 degrees: URDF exporters print 1.5708 for pi/2."""


def exact_right_angles(root: Element) -> None:
    """Replace every `rpy` angle of a URDF that is a rounded multiple of pi/2 by the exact one.

    At an instrument's length the 3.7e-6 rad of "1.5708" are more than a micrometre at the tip.
    """
    for origin in root.iter("origin"):
        if rpy := origin.get("rpy"):
            angles = np.array([float(value) for value in rpy.split()])
            right = np.round(angles / (np.pi / 2)) * (np.pi / 2)
            angles = np.where(np.abs(angles - right) < ROUND_OFF, right, angles)
            origin.set("rpy", " ".join(repr(float(angle)) for angle in angles))


def _skeleton(urdf_text: str) -> str:
    """Links and joints of the URDF, without elements that the kinematics parser warns about."""
    root = ElementTree.fromstring(urdf_text)
    for child in list(root):
        if child.tag not in ("link", "joint"):
            root.remove(child)
        elif child.tag == "link":
            for part in list(child):
                child.remove(part)
        else:
            for part in list(child):
                if part.tag not in _JOINT_PARTS:
                    child.remove(part)
            if child.find("axis") is None:
                ElementTree.SubElement(child, "axis", xyz="1 0 0")  # URDF's default; the parser's is z
    return ElementTree.tostring(root, encoding="unicode")


class Kinematics:
    """Computes transforms of a robot's links from its independent joint positions.

    Args:
        urdf_text: text of the URDF, with exact right angles.
        base_link: reference frame of the transforms; it must not move with any joint.
    """

    def __init__(self, model: yourdfpy.URDF, urdf_text: str, base_link: str | None, source: Path) -> None:
        self.joint_names: tuple[str, ...] = tuple(model.actuated_joint_names)
        joints = model.joint_map
        self.joint_types: tuple[str, ...] = tuple(
            "prismatic" if joints[name].type == "prismatic" else "revolute" for name in self.joint_names
        )
        self.joint_limits: Float[Tensor, "dofs 2"] = torch.tensor(
            [_limits(joints[name]) for name in self.joint_names], dtype=torch.float64
        ).reshape(-1, 2)
        links = list(model.link_map)
        children = {joint.child for joint in joints.values()}
        self.base_link = base_link or next(link for link in links if link not in children)
        if self.base_link not in links:
            raise RobotError(f"{source}: no link is called {self.base_link!r}. The links are: {', '.join(links)}.")
        chain = pytorch_kinematics.build_chain_from_urdf(_skeleton(urdf_text)).to(dtype=torch.float64)
        self._chains = {torch.device("cpu"): chain}
        self._frame_index = {name: int(chain.get_frame_indices(name)[0]) for name in links}
        self._expand, self._offset = _mimic_matrix(model, chain.get_joint_parameter_names())
        self._T_base_root = self._base_transform(source)

    def _base_transform(self, source: Path) -> Tensor:
        probes = torch.stack([torch.zeros(len(self.joint_names)), torch.full((len(self.joint_names),), 0.1)]).double()
        Ts_root_base = self._Ts_root(probes)[self._frame_index[self.base_link]]
        if not torch.allclose(Ts_root_base[0], Ts_root_base[1]):
            raise RobotError(f"{source}: base link {self.base_link!r} moves with a joint; name one that does not.")
        return torch.linalg.inv(Ts_root_base[0])

    def _Ts_root(self, joint_positions: Float[Tensor, "n dofs"]) -> Float[Tensor, "links n 4 4"]:
        device = joint_positions.device
        if device not in self._chains:
            self._chains[device] = copy.deepcopy(self._chains[torch.device("cpu")]).to(device=device)
        expand, offset = self._expand.to(device), self._offset.to(device)
        return self._chains[device].forward_kinematics_tensor(joint_positions @ expand.T + offset)

    def __call__(
        self, joint_positions: Float[Tensor, "*batch dofs"], link_names: tuple[str, ...]
    ) -> Float[Tensor, "*batch links 4 4"]:
        """Ts_base_link [m] of the named links; computed in double precision, returned in the precision of the input.

        Raises:
            RobotError: the last dimension is not the number of degrees of freedom, or there is no such link.
        """
        dofs = len(self.joint_names)
        if joint_positions.shape[-1] != dofs:
            raise RobotError(
                f"got {joint_positions.shape[-1]} joint positions for a robot with {dofs} degrees of freedom: "
                f"{', '.join(self.joint_names)}."
            )
        for name in link_names:
            if name not in self._frame_index:
                raise RobotError(f"the robot has no link {shown(name)}. Its links are: {listed(self._frame_index)}.")
        batch = joint_positions.shape[:-1]
        Ts_root = self._Ts_root(joint_positions.reshape(-1, dofs).double())
        index = torch.tensor([self._frame_index[name] for name in link_names], device=joint_positions.device)
        Ts_base = self._T_base_root.to(joint_positions.device) @ Ts_root[index]
        return Ts_base.transpose(0, 1).reshape(*batch, len(link_names), 4, 4).to(joint_positions.dtype)


def _limits(joint: yourdfpy.Joint) -> tuple[float, float]:
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return -np.inf, np.inf
    # Some URDFs have a huge number for an unlimited joint.
    lower, upper = (
        math.copysign(math.inf, value) if abs(value) > NO_LIMIT else float(value)
        for value in (limit.lower, limit.upper)
    )
    return lower, upper


def _mimic_matrix(model: yourdfpy.URDF, parameters: list[str]) -> tuple[Tensor, Tensor]:
    """Matrix and offset that map independent joint positions to all joint positions of the chain."""
    independent = list(model.actuated_joint_names)
    expand = torch.zeros(len(parameters), len(independent), dtype=torch.float64)
    offset = torch.zeros(len(parameters), dtype=torch.float64)
    for row, name in enumerate(parameters):
        factor, shift, joint = 1.0, 0.0, model.joint_map[name]
        while joint.mimic is not None:
            shift += factor * (joint.mimic.offset or 0.0)
            factor *= joint.mimic.multiplier if joint.mimic.multiplier is not None else 1.0
            joint = model.joint_map[joint.mimic.joint]
        expand[row, independent.index(joint.name)] = factor
        offset[row] = shift
    return expand, offset
