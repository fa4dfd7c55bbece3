"""Closed-form kinematics of the PSM and the ECM."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from carts_core.errors import SettingsError
from carts_core.model.ecm_kinematics import forward as ecm_forward
from carts_core.model.psm_kinematics import CLASSIC, JOINT_NAMES, SI, forward, inverse

GEOMETRIES = {"classic": CLASSIC, "Si": SI, "classic ProGrasp": replace(CLASSIC, wrist_length=0.0107)}


def random_joints(geometry, rows: int, seed: int = 0) -> np.ndarray:
    limits = np.array(geometry.limits)
    return limits[:, 0] + np.random.default_rng(seed).random((rows, 6)) * (limits[:, 1] - limits[:, 0])


@pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)
def test_ten_thousand_poses_inside_the_limits_come_back_to_a_billionth(geometry):
    joints = random_joints(geometry, 10_000)
    found = inverse(forward(joints, geometry), geometry, continuous=False)
    assert found.unreachable == () and found.reachable.all()
    assert np.abs(forward(found.joints, geometry) - forward(joints, geometry)).max() <= 1e-9
    difference = found.joints - joints
    difference[:, 3] -= 2 * np.pi * np.round(difference[:, 3] / (2 * np.pi))
    # With the wrist behind the remote centre an Si arm, whose yaw goes far, can reach some poses in two ways.
    twofold = (np.abs(difference) > 1e-9).any(1)
    assert twofold.sum() <= (3 if geometry is SI else 0)
    assert (joints[twofold, 2] < 0.016).all()


def test_forward_kinematics_is_that_of_the_shipped_robot(shipped_psm):
    joints = random_joints(CLASSIC, 50)
    positions = torch.zeros(50, len(shipped_psm.joint_names), dtype=torch.float64)
    for column, name in enumerate(JOINT_NAMES):
        positions[:, shipped_psm.joint_index(name)] = torch.from_numpy(joints[:, column])
    tips = shipped_psm.link_transform(positions, "tool_tip_link").numpy()
    T_tip_end = np.eye(4)
    T_tip_end[2, 3] = 0.0102
    assert np.abs(forward(joints) @ T_tip_end - tips).max() < 1e-8
    assert np.allclose(inverse(tips, tip_offset=(0.0, 0.0, 0.0102), continuous=False).reachable, True)


def test_roll_follows_the_arm_through_more_than_one_turn():
    joints = np.tile([0.1, -0.2, 0.15, 0.0, 0.3, -0.4], (400, 1))
    joints[:, 3] = np.linspace(-4.4, 4.4, 400)
    found = inverse(forward(joints))
    assert np.abs(found.joints - joints).max() < 1e-9


def test_where_several_turns_fit_the_one_nearest_to_what_is_known_is_taken():
    joints = np.array([[0.1, -0.2, 0.15, 3.5, 0.3, -0.4]])
    poses = forward(joints)
    assert inverse(poses).joints[0, 3] == pytest.approx(3.5 - 2 * np.pi)
    assert inverse(poses, roll_near=3.0).joints[0, 3] == pytest.approx(3.5)


def test_a_pose_that_no_joints_reach_is_said_with_its_row_and_reason_and_not_clamped():
    joints = random_joints(CLASSIC, 5)
    joints[:, 2] = [0.1, 0.3, 0.1, 0.1, 0.1]  # row 1 is beyond the insertion's end
    joints[3, 4] = 1.5
    poses = forward(joints)
    poses[4, 0, 3] = np.nan
    found = inverse(poses, continuous=False)
    assert found.reachable.tolist() == [True, False, True, False, False]
    assert np.isnan(found.joints[[1, 3, 4]]).all()
    said = [str(entry) for entry in found.unreachable]
    assert said == [
        "row 4: the pose is not finite",
        "row 1: insertion would be 0.3 m; allowed: 0 to 0.24 m",
        "row 3: wrist_pitch would be 1.5 rad; allowed: -1.396 to 1.396 rad",
    ]


def test_an_unreachable_row_does_not_break_the_roll_of_the_others():
    joints = np.tile([0.1, -0.2, 0.15, 0.0, 0.3, -0.4], (100, 1))
    joints[:, 3] = np.linspace(-4.4, 4.4, 100)
    poses = forward(joints)
    poses[40] = np.nan
    found = inverse(poses)
    keep = np.arange(100) != 40
    assert np.abs(found.joints[keep] - joints[keep]).max() < 1e-9


def test_impossible_geometries_and_shapes_are_refused_in_words():
    with pytest.raises(SettingsError, match=r"shaft_length is 416 m; allowed: 0 to 1 m. Give metres"):
        replace(CLASSIC, shaft_length=416.0)
    with pytest.raises(SettingsError, match="within 90 degrees"):
        replace(CLASSIC, limits=((-1.6, 1.6), (-0.9, 0.9), (0, 0.24), (-4.5, 4.5), (-1.7, 1.7), (-1.5, 1.5)))
    with pytest.raises(SettingsError, match=r"Give \[rows, 4, 4\]"):
        inverse(np.eye(4))


def test_the_tip_moves_along_a_line_through_the_remote_centre() -> None:
    joints = np.tile([0.3, -0.2, 0.0, 0.5], (3, 1))
    joints[:, 2] = 0.05, 0.1, 0.2
    Ts = ecm_forward(joints)
    assert np.allclose(np.linalg.norm(Ts[:, :3, 3], axis=1), joints[:, 2] - 0.3822 + 0.3829, atol=1e-12)
    assert np.allclose(np.cross(Ts[:, :3, 3], Ts[:, :3, 2]), 0.0, atol=1e-12)


def test_it_turns_as_the_first_four_joints_of_a_psm_do() -> None:
    """Both arms have the same chain up to the roll; the PSM's wrist adds turns that do not depend on them."""
    psm = np.array([[0.3, -0.2, 0.1, 0.5, 0.0, 0.0], [-0.1, 0.4, 0.2, -0.7, 0.0, 0.0]])
    R = [forward(psm)[:, :3, :3], ecm_forward(psm[:, :4])[:, :3, :3]]
    wrists = R[1].transpose(0, 2, 1) @ R[0]
    assert np.allclose(wrists[0], wrists[1], atol=1e-12)
