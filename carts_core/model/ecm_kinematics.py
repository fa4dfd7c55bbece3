"""Forward kinematics of the dVRK's Endoscope Camera Manipulator (ECM).

The chain, in the modified Denavit-Hartenberg parameters (alpha [rad], a [m], theta [rad], d [m]) of
jhu-dvrk/sawIntuitiveResearchKit (share/kinematic/ecm.json and ecm-si.json):

    yaw           pi/2   0   q1 + pi/2   0
    pitch        -pi/2   0   q2 - pi/2   0
    insertion     pi/2   0   0           q3 - 0.3822
    roll          0      0   q4          0.3829

The base frame is at the remote centre of motion; the tip's z axis points along the shaft.
"""

import numpy as np
from jaxtyping import Float

from .psm_kinematics import modified_dh

JOINT_NAMES = ("yaw", "pitch", "insertion", "roll")
"""Names of the joints, in the order of all arrays of this module."""

_REMOTE_CENTER, _ENDOSCOPE = 0.3822, 0.3829
"""Offsets of insertion and roll in the table above [m]."""


def forward(joints: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """T_base_tip [m] at joint positions [rad, m]."""
    q = np.moveaxis(np.asarray(joints, np.float64), -1, 0)
    zero = np.zeros_like(q[0])
    return (
        modified_dh(np.pi / 2, 0.0, q[0] + np.pi / 2, zero)
        @ modified_dh(-np.pi / 2, 0.0, q[1] - np.pi / 2, zero)
        @ modified_dh(np.pi / 2, 0.0, zero, q[2] - _REMOTE_CENTER)
        @ modified_dh(0.0, 0.0, q[3], zero + _ENDOSCOPE)
    )
