"""Where the endoscope's manipulator has its tip."""

import numpy as np

from carts_core.model.ecm_kinematics import forward
from carts_core.model.psm_kinematics import forward as of_psm


def test_the_tip_moves_along_a_line_through_the_remote_centre() -> None:
    joints = np.tile([0.3, -0.2, 0.0, 0.5], (3, 1))
    joints[:, 2] = 0.05, 0.1, 0.2
    Ts = forward(joints)
    assert np.allclose(np.linalg.norm(Ts[:, :3, 3], axis=1), joints[:, 2] - 0.3822 + 0.3829, atol=1e-12)
    assert np.allclose(np.cross(Ts[:, :3, 3], Ts[:, :3, 2]), 0.0, atol=1e-12)


def test_it_turns_as_the_first_four_joints_of_a_psm_do() -> None:
    """Both arms have the same chain up to the roll; the PSM's wrist adds turns that do not depend on them."""
    psm = np.array([[0.3, -0.2, 0.1, 0.5, 0.0, 0.0], [-0.1, 0.4, 0.2, -0.7, 0.0, 0.0]])
    R = [of_psm(psm)[:, :3, :3], forward(psm[:, :4])[:, :3, :3]]
    wrists = R[1].transpose(0, 2, 1) @ R[0]
    assert np.allclose(wrists[0], wrists[1], atol=1e-12)
