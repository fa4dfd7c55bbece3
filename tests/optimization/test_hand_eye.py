"""Base frames from clicked points: found from nothing, with an uncertainty that is true."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clicked_points import clicked
from moving import Motion, let_camera_move, swing
from scipy.spatial.transform import Rotation
from tiny import tiny_scene

from carts_core.cli import main
from carts_core.errors import RobotError, SettingsError
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.optimization.hand_eye import (
    HandEyeSettings,
    ImagePoint,
    agreement_with_points,
    moved_cameras,
    solve_hand_eye,
)
from carts_core.recording import Sequence

FRAMES = 6
FOCAL = 700.0


def joints(seed: int = 3) -> np.ndarray:
    """A working instrument: the arm sweeps some 30 degrees and some 6 cm in depth [frames, dofs]."""
    random = np.random.default_rng(seed)
    low = np.array([-0.25, -0.25, 0.13, -1.5, -0.6, -0.6, 0.0])
    high = np.array([0.25, 0.25, 0.19, 1.5, 0.6, 0.6, 0.3])
    return random.uniform(low, high, (FRAMES, 7))


@pytest.fixture
def scene(shipped_psm: Robot) -> Scene:
    """Two arms before a stereo endoscope."""
    bases = []
    for side in (-1.0, 1.0):
        towards = np.array([0.6 * side, 0.25, 0.76])
        turn = Rotation.align_vectors([towards / np.linalg.norm(towards)], [[0.0, 0.0, -1.0]])[0]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn.as_matrix(), [-0.08 * side, -0.03, 0.0]
        bases.append(T)
    arms = tuple(Arm(f"PSM{number}", shipped_psm, T) for number, T in enumerate(bases, start=1))
    right = np.eye(4)
    right[:3, :3], right[0, 3] = Rotation.from_rotvec([0.0, 0.03, 0.01]).as_matrix(), -0.005
    views = (("left", np.eye(4)), ("right", right))
    return Scene(arms, tuple(Camera(name, 640, 480, (FOCAL, FOCAL, 325.0, 236.0), T) for name, T in views))


def unknown(scene: Scene, *, cameras: bool = False) -> Scene:
    """The scene with base frames, and on request camera poses, that mean nothing."""
    views = tuple(replace(camera, T_camera_world=np.eye(4)) for camera in scene.cameras)
    arms = tuple(replace(arm, T_world_base=np.eye(4)) for arm in scene.arms)
    return replace(scene, arms=arms, cameras=views if cameras else scene.cameras)


def offset(found: Scene, truth: Scene, arm: str, camera: str, points: np.ndarray) -> tuple[float, float, float]:
    """Turn [deg], sideways and depth [mm] between two calibrations, at points of the arm's base frame."""
    Ts = [scene.camera(camera).T_camera_world @ scene.arm(arm).T_world_base for scene in (found, truth)]
    turn = Rotation.from_matrix(Ts[0][:3, :3] @ Ts[1][:3, :3].T).magnitude()
    places = [T[:3, :3] @ points.mean(0) + T[:3, 3] for T in Ts]
    shift = 1e3 * (places[0] - places[1])
    return float(np.degrees(turn)), float(np.linalg.norm(shift[:2])), float(abs(shift[2]))


def tips(scene: Scene, measured: dict[str, np.ndarray], arm: str) -> np.ndarray:
    return scene.arm(arm).robot.forward_kinematics(measured[arm])[:, 2, :3, 3]


@pytest.fixture
def measured(scene: Scene) -> dict[str, np.ndarray]:
    return {arm.name: joints(3 + number) for number, arm in enumerate(scene.arms)}


def test_exact_points_give_the_exact_base_frames_from_nothing(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    points = clicked(scene, measured, range(3), ["left"], noise=0.0)
    result = solve_hand_eye(unknown(scene), measured, points)
    for arm in scene.arms:
        assert np.abs(result.scene.arm(arm.name).T_world_base - arm.T_world_base).max() < 1e-6
    assert result.error < 1e-3 and not result.contradicting and not result.missing


def test_deviations_and_covariances_are_those_that_noise_causes(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    one, ratios, squares = scene.with_arms(["PSM1"]), [], []
    for seed in range(8):
        points = clicked(one, measured, range(4), ["left"], noise=2.0, seed=seed)
        result = solve_hand_eye(unknown(one), measured, points)
        said = result.deviations["PSM1", "left"]
        turn, sideways, depth = offset(result.scene, one, "PSM1", "left", tips(one, measured, "PSM1")[:4])
        ratios.append([turn / said.rotation_deg, sideways / said.sideways_mm, depth / said.depth_mm])
        T = np.linalg.inv(result.scene.arms[0].T_world_base) @ one.arms[0].T_world_base
        error = np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), T[:3, 3]])
        squares.append(error @ np.linalg.solve(result.base_covariances["PSM1"], error))
    # Neither boastful nor useless: errors have the size that is said of them.
    size = np.sqrt((np.array(ratios) ** 2).mean(0))
    assert (size > 0.4).all() and (size < 2.0).all() and np.max(ratios) < 4.0, size
    assert 3.0 < np.mean(squares) < 9.0, "six degrees of freedom"


@pytest.mark.parametrize("wrong", [(0, (60.0, -40.0)), (5, (0.0, 90.0))])
def test_a_wrong_point_hardly_counts_and_is_named(
    scene: Scene, measured: dict[str, np.ndarray], wrong: tuple[int, tuple[float, float]]
) -> None:
    one, (row, by) = scene.with_arms(["PSM1"]), wrong
    points = clicked(one, measured, range(4), ["left"], noise=1.0)
    moved = (points[row].pixel[0] + by[0], points[row].pixel[1] + by[1])
    spoilt = [*points[:row], replace(points[row], pixel=moved), *points[row + 1 :]]
    result = solve_hand_eye(unknown(one), measured, spoilt)
    assert result.contradicting == (row,)
    assert offset(result.scene, one, "PSM1", "left", tips(one, measured, "PSM1"))[1] < 1.5
    assert result.error < 4.0


def test_a_camera_whose_pose_is_not_known_is_found_too(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    points = clicked(scene, measured, range(3), ["left", "right"], noise=0.0)
    result = solve_hand_eye(
        unknown(scene, cameras=True), measured, points, HandEyeSettings(free_cameras=("left", "right"))
    )
    T_right_left = scene.cameras[1].T_camera_world
    assert np.abs(result.scene.cameras[1].T_camera_world - T_right_left).max() < 1e-6
    # The first camera is what the others are measured against.
    assert np.array_equal(result.scene.cameras[0].T_camera_world, np.eye(4))


@pytest.mark.parametrize(("free", "stays"), [(("left", "right"), "right"), (("right",), "left")])
def test_the_reference_camera(scene: Scene, measured: dict[str, np.ndarray], free: tuple[str, ...], stays: str) -> None:
    one = scene.with_arms(["PSM1"])
    points = clicked(one, measured, range(2), ["left"], noise=0.0)
    points += clicked(one, measured, range(3), ["right"], noise=0.0)
    start = unknown(one, cameras=True)
    result = solve_hand_eye(start, measured, points, HandEyeSettings(free_cameras=free))
    assert np.array_equal(result.scene.camera(stays).T_camera_world, np.eye(4))
    left, right = (camera.T_camera_world for camera in result.scene.cameras)
    assert np.abs(right @ np.linalg.inv(left) - scene.cameras[1].T_camera_world).max() < 1e-6


def test_no_base_frame_is_computed_from_an_unknown_camera_pose(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    # The second arm is visible in the free camera alone, with more points than the first one.
    points = clicked(scene.with_arms(["PSM1"]), measured, range(3), ["left"], noise=0.0)
    points += clicked(scene.with_arms(["PSM1"]), measured, range(2), ["right"], noise=0.0)
    points += clicked(scene.with_arms(["PSM2"]), measured, range(4), ["right"], noise=0.0)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.0, 2.0, 1.0]).as_matrix()
    start = unknown(scene)
    start = replace(start, cameras=(start.cameras[0], replace(start.cameras[1], T_camera_world=turned)))
    result = solve_hand_eye(start, measured, points, HandEyeSettings(free_cameras=("right",)))
    for arm in scene.arms:
        assert np.abs(result.scene.arm(arm.name).T_world_base - arm.T_world_base).max() < 1e-6


def test_the_focal_length_is_estimated_on_request(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    one = scene.with_arms(["PSM1"])
    views = tuple(replace(view, intrinsics=(1.4 * FOCAL, 1.4 * FOCAL, 325.0, 236.0)) for view in one.cameras)
    start = replace(unknown(one), cameras=views)
    points = clicked(one, measured, range(FRAMES), ["left"], noise=0.3)
    settings = HandEyeSettings(pixel_error=0.5, focal_length=True)
    result = solve_hand_eye(start, measured, points, settings)
    share = result.scene.camera("left").intrinsics[0] / FOCAL - 1.0
    assert abs(share) < 3.0 * result.focal_deviation["left"] < 0.4
    assert result.scene.camera("right").intrinsics == views[1].intrinsics


def test_what_is_missing_is_counted(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    points = clicked(scene, measured, range(2), ["left"], noise=0.0)
    first = [point for point in points if point.arm == "PSM1"]
    with pytest.raises(SettingsError, match=r"PSM1 needs 1 more point in left.*Points on the shaft are not counted"):
        solve_hand_eye(unknown(scene), measured, [point for point in first if point.landmark != "shaft edge"][:3])
    with pytest.raises(SettingsError, match=r"there are no points. Click tip"):
        solve_hand_eye(unknown(scene), measured, [])
    some = solve_hand_eye(unknown(scene), measured, [*first, *[point for point in points if point.arm == "PSM2"][:2]])
    assert some.missing == {("PSM2", "left"): 2}
    assert np.array_equal(some.scene.arm("PSM2").T_world_base, np.eye(4))


def test_points_that_cannot_be_used_are_refused_in_words(scene: Scene, measured: dict[str, np.ndarray]) -> None:
    good = clicked(scene, measured, range(2), ["left"], noise=0.0)
    with pytest.raises(SettingsError, match="no frame 99; frames are 0 to 5"):
        solve_hand_eye(scene, measured, [replace(good[0], frame=99)])
    with pytest.raises(SettingsError, match=r"has no 'elbow'. Its landmarks are: tip, wrist yaw joint"):
        solve_hand_eye(scene, measured, [replace(good[0], landmark="elbow")])
    with pytest.raises(RobotError, match="there is no camera 'top'"):
        solve_hand_eye(scene, measured, [replace(good[0], camera="top")])
    with pytest.raises(SettingsError, match="Give two finite numbers"):
        solve_hand_eye(scene, measured, [replace(good[0], pixel=(float("nan"), 1.0))])
    same = [ImagePoint(0, "left", "PSM1", "tip", (300.0, 200.0))] * 6
    with pytest.raises(SettingsError, match=r"Click other points|Click points in frames"):
        solve_hand_eye(scene, measured, same)


def test_the_real_stereo_frames_are_calibrated_from_points_alone(shared_dir: Path) -> None:
    sequence = Sequence.open(Path(__file__).parent.parent / "sequences/dvrk_stereo.toml")
    points = clicked(sequence.scene, sequence.measured, (3, 9, 16, 22), ["left", "right"], noise=2.0)
    start = unknown(sequence.scene, cameras=True)
    result = solve_hand_eye(start, sequence.measured, points, HandEyeSettings(free_cameras=("right",)))
    places = tips(sequence.scene, dict(sequence.measured), "PSM1")
    for camera in ("left", "right"):
        turn, sideways, depth = offset(result.scene, sequence.scene, "PSM1", camera, places)
        said = result.deviations["PSM1", camera]
        assert turn < 3.0 * said.rotation_deg < 6.0
        assert sideways < 3.0 * said.sideways_mm < 2.0 and depth < 3.0 * said.depth_mm < 9.0
    assert result.error < 4.0


def write_points(path: Path, sequence: Sequence, points: list[ImagePoint]) -> None:
    rows = [
        f"{sequence.frame_ids[point.frame]},{point.camera},PSM1,{point.landmark},{point.pixel[0]},{point.pixel[1]}"
        for point in points
    ]
    path.write_text("frame,camera,arm,landmark,u,v\n" + "\n".join(rows) + "\n")


def test_the_command_reads_a_table_and_writes_a_sequence_file(
    tiny_sequence: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny_sequence(frames=5, cameras=("left", "right"), width=640, height=480)
    sequence = Sequence.open(path)
    points = clicked(sequence.scene, sequence.measured, range(5), ["left"], noise=0.0)
    table = tmp_path / "points.csv"
    write_points(table, sequence, points)
    main(["hand-eye", str(path), "--points", str(table), "--output", str(tmp_path / "out")])
    said = " ".join(capsys.readouterr().out.split())
    assert "20 points, residual 0.0 px" in said and "PSM1 in left: standard deviation" in said
    assert "another pose" not in said
    after = Sequence.open(tmp_path / "out/sequence.toml")
    assert np.abs(after.scene.arms[0].T_world_base - sequence.scene.arms[0].T_world_base).max() < 1e-5
    written = json.loads((tmp_path / "out/hand_eye.json").read_text())
    assert len(written["points"]) == 20 and written["poses"][0]["deviation"]["depth_mm"] > 0
    table.write_text("frame,camera\n001,left\n")
    with pytest.raises(SystemExit):
        main(["hand-eye", str(path), "--points", str(table), "--output", str(tmp_path / "other")])
    assert "has no column 'arm'" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "other").exists()


def test_written_poses_of_a_moving_camera_are_those_at_the_time_of_the_points(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
    Ts = swing(4, 3.0, 0.002).Ts_world_mount
    path = let_camera_move(tiny_sequence(frames=4, width=320, height=240), Motion(Ts[[0, 1, 1, 1]]))
    sequence = Sequence.open(path)
    there = moved_cameras(sequence.scene, sequence.mounts(1))
    write_points(tmp_path / "points.csv", sequence, clicked(there, sequence.measured, (1, 2, 3), ["left"], noise=0.0))
    main(["hand-eye", str(path), "--points", str(tmp_path / "points.csv"), "--output", str(tmp_path / "out")])
    (pose,) = json.loads((tmp_path / "out/hand_eye.json").read_text())["poses"]
    assert np.allclose(pose["T_camera_base"], there.cameras[0].T_camera_world @ there.arms[0].T_world_base, atol=1e-5)
    after = Sequence.open(tmp_path / "out/sequence.toml").scene
    assert np.allclose(after.cameras[0].T_camera_world, sequence.scene.cameras[0].T_camera_world, atol=1e-9)
    assert np.allclose(after.arms[0].T_world_base, sequence.scene.arms[0].T_world_base, atol=1e-5)


def test_edges_that_were_all_clicked_on_one_side_are_tried_on_both_sides_of_the_shaft(shipped_psm: Robot) -> None:
    """Without both sides, the pose is off by 19 deg. Another pose can fit points of the tip alone, which is said."""
    tiny = tiny_scene(shipped_psm, 8, ("left",), 310, 244)
    measured = {"PSM1": tiny.truth}
    names = ("tip", "shaft edge", "shaft edge")
    points = clicked(tiny.scene, measured, (0, 2, 5, 7), ["left"], noise=2.0, names=names, side=1.0, seed=1)
    result = solve_hand_eye(unknown(tiny.scene), measured, points)
    turn, sideways, _ = offset(result.scene, tiny.scene, "PSM1", "left", tips(tiny.scene, measured, "PSM1"))
    assert turn < 4.0 and sideways < 1.0 and result.distances.max() < 3.5
    assert result.ambiguous == (("PSM1", "left"),)


def test_a_further_camera_is_found_from_four_points_that_nearly_lie_in_a_plane(shipped_psm: Robot) -> None:
    """The tip and the shaft's end in two frames of a small motion: perspective-n-point alone finds no pose there."""
    tiny = tiny_scene(shipped_psm, 8, ("left", "right"), 320, 240)
    measured = {"PSM1": tiny.truth * np.array([1.0, 1, 1, 1, 1, 1, 0])}
    names = ("tip", "wrist pitch joint", "shaft edge")
    for seed in range(2):
        points = clicked(tiny.scene, measured, (0, 1, 2, 5), ["left"], noise=0.5, seed=seed, names=names)
        points += clicked(tiny.scene, measured, (0, 5), ["right"], noise=0.5, seed=seed + 50, names=names)
        settings = HandEyeSettings(free_cameras=("right",))
        result = solve_hand_eye(unknown(tiny.scene, cameras=True), measured, points, settings)
        said = result.deviations["PSM1", "right"]
        place = tiny.scene.arms[0].robot.forward_kinematics(measured["PSM1"])[:, 2, :3, 3]
        _, sideways, depth = offset(result.scene, tiny.scene, "PSM1", "right", place)
        assert sideways < 4.0 * said.sideways_mm < 3.0 and depth < 4.0 * said.depth_mm and result.error < 1.5


@pytest.mark.slow
def test_a_refinement_keeps_to_what_the_points_left_open_and_to_known_cameras(
    tiny_sequence: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny_sequence(frames=2, cameras=("left", "right"), width=160, height=120)
    sequence = Sequence.open(path)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians([0.0, 9.0, 0.0])).as_matrix()
    arm = sequence.scene.arms[0]
    wrong = replace(sequence.scene, arms=(replace(arm, T_world_base=arm.T_world_base @ turn),))
    for name, scene in (("right", sequence.scene), ("wrong", wrong)):
        points = clicked(scene, sequence.measured, range(2), ["left", "right"], noise=0.5)
        write_points(tmp_path / f"{name}.csv", sequence, points)
        given = ["--points", str(tmp_path / f"{name}.csv"), "--pixel-error", "0.5"]
        main(["hand-eye", str(path), *given, "--output", str(tmp_path / name)])
    refine = ["--observe", "masks", "--frames", "all"]
    capsys.readouterr()
    main(["calibrate", str(tmp_path / "right/sequence.toml"), *refine, "--output", str(tmp_path / "refined")])
    assert "fixed, since known before `carts hand-eye`: the pose of left, right" in capsys.readouterr().out
    refined = Sequence.open(tmp_path / "refined/sequence.toml").scene
    for before, after in zip(sequence.scene.cameras, refined.cameras, strict=True):
        assert np.allclose(before.T_camera_world, after.T_camera_world, atol=1e-9)
    assert not np.array_equal(refined.arms[0].T_world_base, arm.T_world_base)
    # As if the points had left nothing open.
    known = json.loads((tmp_path / "wrong/hand_eye.json").read_text())
    known["base_frames"]["PSM1"]["covariance"] = (1e-8 * np.eye(6)).tolist()
    (tmp_path / "wrong/hand_eye.json").write_text(json.dumps(known))
    again = ["calibrate", str(tmp_path / "wrong/sequence.toml"), *refine, "--output", str(tmp_path / "moved")]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(again)
    said = " ".join(capsys.readouterr().err.split())
    assert (
        "he calibration moves the base frame of PSM1 by" in said
        and "its hand-eye calibration has standard deviations" in said
    )
    assert "--beyond-hand-eye" in said and not (tmp_path / "moved").exists()


@pytest.mark.parametrize(
    ("turn_deg", "noise", "agrees"), [(0.0, 2.0, True), (0.0, 5.0, True), (4.0, 2.0, False), (0.02, 0.1, True)]
)
def test_points_reject_another_calibration(scene: Scene, turn_deg: float, noise: float, agrees: bool) -> None:
    scene = scene.with_arms(["PSM1"])
    measured = {"PSM1": joints()}
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, turn_deg, 0.0], degrees=True).as_matrix()
    other = replace(scene, arms=tuple(replace(arm, T_world_base=turn @ arm.T_world_base) for arm in scene.arms))
    points = clicked(scene, measured, range(4), ["left"], noise=noise)
    found = solve_hand_eye(unknown(scene), measured, points)
    compared = agreement_with_points(other, measured, points, found)
    assert compared.agrees is agrees
    assert compared.before == pytest.approx(found.distances, nan_ok=True)
    if not agrees:
        assert compared.rms_after > 1.3 * compared.rms_limit and len(compared.disagreeing) > len(points) / 4
