"""Forward kinematics of a URDF's tree, differentiable and batched."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import RobotError
from ..wording import listed, shown
from .urdf import Joint, Urdf

ROUND_OFF = 1e-5
"""Angles this close [rad] to a multiple of 90 degrees mean that multiple: URDF exporters print 1.5708 for pi/2."""


def exact_right_angles(root: Element) -> None:
    """Put every `rpy` angle of a URDF that is a rounded multiple of pi/2 back to the exact one.

    At an instrument's length the 3.7e-6 rad of "1.5708" are more than a micrometre at the tip.
    """
    for origin in root.iter("origin"):
        if rpy := origin.get("rpy"):
            angles = np.array([float(value) for value in rpy.split()])
            right = np.round(angles / (np.pi / 2)) * (np.pi / 2)
            angles = np.where(np.abs(angles - right) < ROUND_OFF, right, angles)
            origin.set("rpy", " ".join(repr(float(angle)) for angle in angles))


class Kinematics:
    """Transforms of a robot's links from its independent joint positions.

    A joint's own motion is `I + s A + c B` with constant matrices: where it turns by q about the axis with the
    cross-product matrix K, `s = sin q`, `c = 1 - cos q`, `A = K` and `B = K K` (Rodrigues' formula); where it slides by
    q along its axis, `s = q` and `A` has the axis in its last column.

    Args:
        model: the parsed URDF, with exact right angles.
        base_link: the frame that transforms are given in; it must not move with any joint.
        source: file named in errors.
    """

    def __init__(self, model: Urdf, base_link: str | None, source: Path) -> None:
        free = model.free_joints
        self.joint_names: tuple[str, ...] = tuple(joint.name for joint in free)
        self.joint_types: tuple[str, ...] = tuple("revolute" if joint.turns else "prismatic" for joint in free)
        self.joint_limits: Float[Tensor, "dofs 2"] = torch.tensor(
            [joint.limits for joint in free], dtype=torch.float64
        ).reshape(-1, 2)
        links = [link.name for link in model.links]
        self.base_link = base_link or model.root
        if self.base_link not in links:
            raise RobotError(f"{source}: no link is called {self.base_link!r}. The links are: {', '.join(links)}.")
        joints = model.downwards()
        self._row = {name: row for row, name in enumerate([model.root, *(joint.child for joint in joints)])}
        self._parents = [self._row[joint.parent] for joint in joints]
        constants = [*_mimic_matrix(joints, self.joint_names), *_motions(joints)]
        constants.append(np.array([joint.turns for joint in joints], bool))
        self._constants = {torch.device("cpu"): tuple(torch.from_numpy(constant) for constant in constants)}
        self._T_base_root = self._base_transform(source)

    def _base_transform(self, source: Path) -> Tensor:
        probes = torch.stack([torch.zeros(len(self.joint_names)), torch.full((len(self.joint_names),), 0.1)]).double()
        Ts_root_base = self._Ts_root(probes)[self._row[self.base_link]]
        if not torch.allclose(Ts_root_base[0], Ts_root_base[1]):
            raise RobotError(f"{source}: base link {self.base_link!r} moves with a joint; name one that does not.")
        return torch.linalg.inv(Ts_root_base[0])

    def _Ts_root(self, joint_positions: Float[Tensor, "n dofs"]) -> Float[Tensor, "links n 4 4"]:
        device = joint_positions.device
        if device not in self._constants:
            self._constants[device] = tuple(value.to(device) for value in self._constants[torch.device("cpu")])
        expand, offset, T_parent_joint, A, B, turns = self._constants[device]
        q = joint_positions @ expand.T + offset
        s, c = torch.where(turns, q.sin(), q), torch.where(turns, 1.0 - q.cos(), 0.0)
        Ts_parent_child = T_parent_joint + s[..., None, None] * A + c[..., None, None] * B
        Ts = [torch.eye(4, dtype=q.dtype, device=device).expand(len(q), 4, 4)]
        for parent, T in zip(self._parents, Ts_parent_child.unbind(1), strict=True):
            Ts.append(Ts[parent] @ T)
        return torch.stack(Ts)

    def __call__(
        self, joint_positions: Float[Tensor, "*batch dofs"], link_names: tuple[str, ...]
    ) -> Float[Tensor, "*batch links 4 4"]:
        """Ts_base_link of the named links; computed in double precision, returned in the input's.

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
            if name not in self._row:
                raise RobotError(f"the robot has no link {shown(name)}. Its links are: {listed(self._row)}.")
        batch = joint_positions.shape[:-1]
        Ts_root = self._Ts_root(joint_positions.reshape(-1, dofs).double())
        index = torch.tensor([self._row[name] for name in link_names], device=joint_positions.device)
        Ts_base = self._T_base_root.to(joint_positions.device) @ Ts_root[index]
        return Ts_base.transpose(0, 1).reshape(*batch, len(link_names), 4, 4).to(joint_positions.dtype)


def _motions(joints: list[Joint]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_parent_joint, T_parent_joint A and T_parent_joint B of every joint [joints, 4, 4]."""
    T, A, B = (np.zeros((len(joints), 4, 4)) for _ in range(3))
    for row, joint in enumerate(joints):
        T[row] = joint.T_parent_joint
        if joint.turns:
            K = np.zeros((4, 4))
            K[:3, :3] = np.cross(np.eye(3), joint.axis)
            A[row], B[row] = T[row] @ K, T[row] @ K @ K
        elif joint.moves:
            A[row, :3, 3] = T[row, :3, :3] @ joint.axis
    return T, A, B


def _mimic_matrix(joints: list[Joint], independent: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Matrix [joints, dofs] and offset [joints] that turn independent joint positions into all of them."""
    named = {joint.name: joint for joint in joints}
    expand, offset = np.zeros((len(joints), len(independent))), np.zeros(len(joints))
    for row, joint in enumerate(joints):
        if not joint.moves:
            continue
        factor, followed = 1.0, joint
        while (mimic := followed.mimic) is not None:
            offset[row] += factor * mimic.offset
            factor *= mimic.factor
            followed = named[mimic.joint]
        expand[row, independent.index(followed.name)] = factor
    return expand, offset
