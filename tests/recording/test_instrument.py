"""Base frames and instruments from recordings with joints and poses, made up and real."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from carts_core.errors import CartsError
from carts_core.model.psm_kinematics import CLASSIC, forward, inverse
from carts_core.recording.importing import CANDIDATES, at_times, check_instrument, clock_offset, fit_base_frame


def motion(rows: int = 200) -> np.ndarray:
    time = np.linspace(0, 8, rows)[:, None]
    center = np.array([0.1, 0.05, 0.15, 0.5, 0.1, -0.2])
    return center + np.array([0.3, 0.2, 0.04, 1.0, 0.6, 0.5]) * np.sin(time * [0.9, 1.1, 0.7, 0.5, 1.7, 1.3])


@pytest.fixture(scope="module")
def base() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.4, -1.0, 0.3]).as_matrix()
    T[:3, 3] = 0.1, -0.2, 0.3
    return T


@pytest.fixture(scope="module")
def real_bag(request):
    """The real bag's measured_js and measured_cp: times [s], joints, times [s], poses."""
    path = request.config.rootpath.parent / "shared/data/dvrk_bag/pitch_exp_traj_01_test_cropped.bag"
    if not path.is_file():
        pytest.skip("the real bag is not beside this checkout")
    highlevel = pytest.importorskip("rosbags.highlevel")
    rows = {"/PSM2/measured_js": [], "/PSM2/measured_cp": []}
    with highlevel.AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic in rows]
        for connection, _, raw in reader.messages(wanted):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            time = (stamp.sec - 1644257420) + 1e-9 * stamp.nanosec
            if connection.topic.endswith("js"):
                values = message.position
            else:
                p, q = message.pose.position, message.pose.orientation
                values = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
            rows[connection.topic].append([time, *values])
    js, cp = (np.array(table) for table in rows.values())
    Ts = np.tile(np.eye(4), (len(cp), 1, 1))
    Ts[:, :3, :3], Ts[:, :3, 3] = Rotation.from_quat(cp[:, 4:]).as_matrix(), cp[:, 1:4]
    return js[:, 0], js[:, 1:], cp[:, 0], Ts


def test_joints_from_poses_of_the_real_bag_are_its_measured_joints(real_bag):
    joint_times, joints, pose_times, Ts = real_bag
    measured = at_times(pose_times - clock_offset(pose_times, joint_times), joint_times, joints)
    between = np.isfinite(measured).all(1)
    assert between.sum() >= len(Ts) - 2, "only rows before the first and after the last one may be left out"
    base_frame = fit_base_frame(Ts, measured)
    found = inverse(np.linalg.inv(base_frame.T_reference_base) @ Ts)
    assert found.unreachable == ()
    error = np.abs(found.joints - measured)[between].max(0)
    assert np.degrees(error[[0, 1, 3, 4, 5]]).max() <= 0.05
    assert 1e3 * error[2] <= 0.05


def test_the_instrument_of_the_real_bag_is_found_and_others_are_refused(real_bag):
    joint_times, joints, pose_times, Ts = real_bag
    measured = at_times(pose_times - clock_offset(pose_times, joint_times), joint_times, joints)
    check = check_instrument(Ts, measured, {**CANDIDATES, "Si shaft": replace(CLASSIC, shaft_length=0.4670)})
    assert check.best == "9.1 mm wrist" and check.decides
    assert check.fits["9.1 mm wrist"].deviation <= 2e-5
    assert [name for name in check.fits if check.accepts(name)] == ["9.1 mm wrist"]


def test_the_base_frame_is_found_and_wrong_wrists_and_shafts_are_refused(base):
    joints = motion()
    check = check_instrument(base @ forward(joints, replace(CLASSIC, wrist_length=0.0107)), joints)
    assert check.best == "10.7 mm wrist" and check.decides
    assert np.abs(check.fits[check.best].T_reference_base - base).max() < 1e-9
    assert check.warning(check.best) is None
    assert "consistent with 10.7 mm wrist" in (check.warning("9.1 mm wrist") or "")
    wrong_shaft = check_instrument(base @ forward(joints, replace(CLASSIC, shaft_length=0.4670)), joints)
    assert not wrong_shaft.accepts(wrong_shaft.best)
    assert "No known instrument fits" in (wrong_shaft.warning("9.1 mm wrist") or "")


def test_an_arm_that_does_not_move_decides_nothing(base):
    joints = np.tile(motion(1), (50, 1))
    check = check_instrument(base @ forward(joints), joints)
    assert not check.decides


def test_topics_of_one_cycle_are_aligned_by_their_constant_delay():
    times = np.arange(100) / 100
    later = times + 0.0003
    assert clock_offset(later, times) == pytest.approx(0.0003)
    assert clock_offset(times[:-1] + 0.005, times) == 0.0
    values = at_times(np.array([-1.0, 0.005, 2.0]), times, np.stack([times, 2 * times], 1))
    assert np.isnan(values[[0, 2]]).all()
    assert np.allclose(values[1], [0.005, 0.01])


def test_too_few_rows_with_both_are_an_error_in_words(base):
    joints = np.full((30, 6), np.nan)
    with pytest.raises(CartsError, match="no row has both"):
        fit_base_frame(np.tile(base, (30, 1, 1)), joints)
    with pytest.raises(CartsError, match="at least 20 are needed"):
        check_instrument(np.tile(base, (30, 1, 1)), joints)
