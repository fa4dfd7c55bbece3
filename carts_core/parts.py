"""Parts that surgical instruments have in common, whatever their links are called."""

import numpy as np
import torch
from jaxtyping import Int

from .robot import Robot

PARTS = ("shaft", "wrist", "jaws")
"""In the order of their index."""

_PROBE = 0.1


def link_parts(robot: Robot) -> Int[np.ndarray, " links"]:
    """Index into `PARTS` of each link with a mesh, told by how many degrees of freedom move it.

    What all but the last two move is the wrist, what more of them move are the jaws with what they turn on, and
    everything else belongs to the shaft.
    """
    dofs = len(robot.joint_names)
    probes = torch.cat([torch.zeros(1, dofs), _PROBE * torch.eye(dofs)]).double()
    Ts = robot.forward_kinematics(probes)
    movers = ((Ts[1:] - Ts[:1]).abs().amax((-2, -1)) > 1e-9).sum(0).numpy()
    # A robot without a wrist is all shaft.
    return (movers >= max(movers.max() - 2, 1)).astype(int) + (movers >= max(movers.max() - 1, 2))
