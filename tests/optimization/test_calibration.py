"""Calibration over many frames, with a predictor of the true surface maps."""

from collections.abc import Callable
from copy import copy
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
import roma
import torch
from perfect_predictor import NumberedTruths, numbered

from carts_core.errors import CartsError
from carts_core.model.scene import Scene
from carts_core.optimization import (
    CALIBRATION,
    CALIBRATION_SETTINGS,
    Backgrounds,
    CalibrationOptimizer,
    DescentSolver,
    FreeParameters,
    StopReason,
    Verdict,
)
from carts_core.optimization.calibration import UnknownChange, with_fixed_gauge
from carts_core.optimization.calibration_problem import eliminate, frame_weights
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer
from carts_core.settings.stages import Descend, Observe

FRAMES, SIZE = 6, (320, 240)
# Cameras that are given wrong ought to be found as wrong: a loose prior, and fewer stages than for real images. Colours
# stay as they are, because they number the frames.
FAR = Observe(margin=27, attention=27)
DESCENTS = (Descend(6.0), Descend(2.0), Descend(0.8))
SETTINGS = replace(CALIBRATION_SETTINGS, frame_prior_deg=10.0, stages=(FAR, *DESCENTS), dehaze=0.0)


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=FRAMES, cameras=("left", "right"), width=SIZE[0], height=SIZE[1]))


@pytest.fixture(scope="module")
def frames(sequence: Sequence) -> list[Frame]:
    return [numbered(sequence.frame(index)) for index in range(FRAMES)]


@pytest.fixture(scope="module")
def made_predictor(sequence: Sequence, frames: list[Frame]) -> NumberedTruths:
    return NumberedTruths(sequence.scene, frames)


@pytest.fixture
def predictor(made_predictor: NumberedTruths) -> NumberedTruths:
    return copy(made_predictor)


def rigid(degrees: list[float], millimetres: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = roma.rotvec_to_rotmat(torch.tensor(degrees).double().deg2rad()).numpy()
    T[:3, 3] = np.array(millimetres) / 1000
    return T


def with_wrong_base(scene: Scene) -> Scene:
    arm = scene.arms[0]
    return replace(
        scene, arms=(replace(arm, T_world_base=arm.T_world_base @ rigid([1.0, -1.5, 1.0], [2.0, -1.0, 1.5])),)
    )


def with_wrong_right_camera(scene: Scene) -> Scene:
    left, right = scene.cameras
    T = rigid([0.5, -0.7, 0.6], [1.0, -1.0, 0.5]) @ right.T_camera_world
    return replace(scene, cameras=(left, replace(right, T_camera_world=T)))


def worst_error(scene: Scene, truth: Scene, joint_positions: np.ndarray) -> tuple[float, float]:
    """Of where the instrument is seen, over all cameras: angle [deg] and distance of its last link [mm]."""
    robot = scene.arms[0].robot
    T_base_tip = robot.forward_kinematics(torch.tensor(joint_positions))[robot.meshes[-1].link].numpy()
    angles, distances = [], []
    for found, wanted in zip(scene.cameras, truth.cameras, strict=True):
        T_found = found.T_camera_world @ scene.arms[0].T_world_base @ T_base_tip
        T_wanted = wanted.T_camera_world @ truth.arms[0].T_world_base @ T_base_tip
        turn = torch.tensor(T_found[:3, :3].T @ T_wanted[:3, :3])
        angles.append(float(roma.rotmat_to_rotvec(turn).norm().rad2deg()))
        distances.append(1000 * float(np.linalg.norm(T_found[:3, 3] - T_wanted[:3, 3])))
    return max(angles), max(distances)


def test_base_frame_and_camera_are_found(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    wrong = with_wrong_right_camera(with_wrong_base(sequence.scene))
    optimizer = CalibrationOptimizer(wrong, frames, predictor, settings=SETTINGS)
    list(optimizer)
    result = optimizer.result()
    positions = frames[1].measured["PSM1"]
    before = worst_error(wrong, sequence.scene, positions)
    angle, distance = worst_error(result.scene, sequence.scene, positions)
    assert before[0] > 1.5 and before[1] > 3.0
    assert angle < 0.2 and distance < 0.5
    assert result.frame_losses_after.max() < 0.2 * result.frame_losses_before.min()
    assert np.array_equal(result.scene.cameras[0].T_camera_world, wrong.cameras[0].T_camera_world)
    assert result.stop_reason == "converged" and len(optimizer.history) == optimizer.history[-1].index + 1
    for unknown in result.unknowns:
        assert 0 < unknown.deviation <= unknown.prior_deviation * (1 + 1e-6)
    assert set(result.deviations) == {("PSM1", "left"), ("PSM1", "right")}
    for deviation in result.deviations.values():
        assert angle < 4 * deviation.rotation_deg < 20
        assert distance < 4 * np.hypot(deviation.sideways_mm, deviation.depth_mm) < 40


def test_an_arm_that_is_never_in_view_has_the_deviations_of_the_prior(
    sequence: Sequence, frames: list[Frame], predictor: NumberedTruths
) -> None:
    arm = sequence.scene.arms[0]
    parked = replace(arm, name="PSM2", T_world_base=rigid([0.0, 0.0, 0.0], [5000.0, 0.0, 0.0]) @ arm.T_world_base)
    wrong = with_wrong_base(sequence.scene)
    scene = replace(wrong, arms=(*wrong.arms, parked))
    both = [replace(frame, measured={**frame.measured, "PSM2": frame.measured["PSM1"]}) for frame in frames]
    optimizer = CalibrationOptimizer(scene, both, predictor, settings=SETTINGS, free=FreeParameters(base_frames=True))
    list(optimizer)
    result = optimizer.result()
    for unknown in result.unknowns:
        assert np.isfinite(unknown.standard_deviation)
        if unknown.name.startswith("PSM2/base"):
            assert unknown.standard_deviation >= 0.99 * unknown.prior_deviation
    assert all(np.isfinite(astuple(deviation)).all() for deviation in result.deviations.values())


def test_failed_calibrations_keep_the_start(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    wrong = with_wrong_base(sequence.scene)
    right = CalibrationOptimizer(wrong, frames, predictor, settings=SETTINGS)
    list(right)
    assert right.assessment is not None and right.assessment.verdict is Verdict.GOOD
    # Every image belongs to the kinematics of another frame.
    predictor.maps = [maps.flip(-1) for maps in predictor.maps]
    failed = CalibrationOptimizer(wrong, frames, predictor, settings=SETTINGS)
    list(failed)
    result = failed.result()
    assert result.assessment is not None and result.assessment.verdict is Verdict.FAILED and result.assessment.remedy
    assert result.stop_reason is StopReason.FAILED
    assert np.array_equal(result.scene.arms[0].T_world_base, wrong.arms[0].T_world_base)


@pytest.mark.slow
def test_deviations_of_few_frames_are_wider(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    free = FreeParameters(joints=False, base_frames=True)

    def found(count: int) -> tuple[UnknownChange, ...]:
        optimizer = CalibrationOptimizer(
            with_wrong_base(sequence.scene), frames[:count], predictor, settings=SETTINGS, free=free, cameras=["left"]
        )
        list(optimizer)
        return optimizer.result().unknowns

    for unknown in found(1):
        assert unknown.deviation_between_frames is None
        assert unknown.standard_deviation > 1.5 * unknown.deviation
    for unknown in found(2):
        between = unknown.deviation_between_frames
        assert between is not None and unknown.standard_deviation > max(between, unknown.deviation)


@pytest.mark.parametrize("count", [1, 3])
def test_few_frames_within_deviations(
    sequence: Sequence, frames: list[Frame], predictor: NumberedTruths, count: int
) -> None:
    free = FreeParameters(joints=False, base_frames=True)
    wrong, truth = (scene.with_cameras(["left"]) for scene in (with_wrong_base(sequence.scene), sequence.scene))
    optimizer = CalibrationOptimizer(wrong, frames[:count], predictor, settings=SETTINGS, free=free)
    list(optimizer)
    result, positions = optimizer.result(), frames[0].measured["PSM1"]
    angle, distance = worst_error(result.scene, truth, positions)
    known = result.deviations["PSM1", "left"]
    assert distance < 0.5 * worst_error(wrong, truth, positions)[1]
    assert angle < 4 * known.rotation_deg and distance < 4 * np.hypot(known.sideways_mm, known.depth_mm)


@pytest.mark.slow
def test_backgrounds_count_in_a_calibration(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    renderer = Renderer(sequence.scene, cameras=["left"])
    bright = []
    for frame in frames:
        arm = renderer.segment(sequence.scene.state(frame.measured))[0] >= 0
        bright.append(replace(frame, images={"left": np.where(arm[..., None], 255, frame.images["left"]).astype("u1")}))
    backgrounds = Backgrounds({"left": np.zeros((SIZE[1], SIZE[0], 3), np.uint8)})
    free = FreeParameters(joints=False, base_frames=True)
    optimizer = CalibrationOptimizer(
        with_wrong_base(sequence.scene),
        bright,
        predictor,
        settings=SETTINGS,
        free=free,
        cameras=["left"],
        backgrounds=backgrounds,
    )
    list(optimizer)
    assert optimizer.assessment is not None and optimizer.assessment.verdict is Verdict.GOOD
    overlap = optimizer.assessment.evidence.overlap_with_change
    assert overlap is not None and overlap > 0.9


@pytest.mark.slow
def test_freed_joints_absorb_frame_errors(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (FRAMES, 2))
    shaken = [
        replace(frame, measured={"PSM1": frame.measured["PSM1"] + np.deg2rad([*sign, 0, 0, 0, 0, 0])})
        for frame, sign in zip(frames, signs, strict=True)
    ]
    wrong = with_wrong_base(sequence.scene)

    def loss(free: FreeParameters) -> float:
        optimizer = CalibrationOptimizer(
            wrong, shaken, predictor, settings=SETTINGS, free=free, joint_prior_deg=1.0, cameras=["left"]
        )
        list(optimizer)
        assert optimizer.best is not None
        return optimizer.best.loss

    held = loss(FreeParameters(joints=False, base_frames=True))
    assert loss(FreeParameters(joints=True, base_frames=True)) < 0.5 * held


@pytest.mark.slow
def test_outlier_frames_hardly_matter(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    broken = {"PSM1": frames[0].measured["PSM1"] + np.deg2rad([4, -4, 0, 0, 0, 0, 0])}
    mixed = [replace(frames[0], measured=broken), *frames[1:]]
    free = FreeParameters(joints=False, base_frames=True)
    settings = replace(SETTINGS, stages=(FAR, DESCENTS[0], Observe(), *DESCENTS[1:]))
    wrong = with_wrong_base(sequence.scene)
    optimizer = CalibrationOptimizer(wrong, mixed, predictor, settings=settings, free=free, cameras=["left"])
    list(optimizer)
    result = optimizer.result()
    assert result.frame_weights[0] < 0.1 and result.frame_weights[1:].min() > 0.5
    assert worst_error(result.scene, sequence.scene, frames[1].measured["PSM1"])[1] < 1.0


def test_the_schur_complement_solves_what_the_whole_system_solves() -> None:
    generator = torch.Generator().manual_seed(0)
    own, shared, count = 3, 4, 5
    factors = torch.randn(count, own + shared, own + shared, generator=generator, dtype=torch.float64)
    curvatures = factors @ factors.transpose(1, 2) + torch.eye(own + shared)
    gradients = torch.randn(count, own + shared, generator=generator, dtype=torch.float64)
    size = shared + count * own
    whole, right = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size, dtype=torch.float64)
    for frame in range(count):
        here = [*range(shared + frame * own, shared + (frame + 1) * own), *range(shared)]
        whole[np.ix_(here, here)] += curvatures[frame]
        right[here] += gradients[frame]
    wanted = torch.linalg.solve(whole, -right)
    models = [eliminate(g, c, own) for g, c in zip(gradients, curvatures, strict=True)]
    curvature = torch.stack([model.curvature for model in models]).sum(0)
    step = torch.linalg.solve(curvature, -torch.stack([model.gradient for model in models]).sum(0))
    torch.testing.assert_close(step, wanted[:shared])
    torch.testing.assert_close(torch.cat([model.own_step(step) for model in models]), wanted[shared:])
    torch.testing.assert_close(torch.linalg.inv(curvature), torch.linalg.inv(whole)[:shared, :shared])


def test_frames_are_trusted_by_their_loss_beside_the_median() -> None:
    weights = frame_weights(torch.tensor([0.1, 0.1, 0.12, 0.0, 1.5], dtype=torch.float64))
    assert weights[:4].tolist() == [1.0] * 4 and float(weights[4]) == pytest.approx(0.01)
    assert frame_weights(torch.zeros(2)).tolist() == [1.0, 1.0]


def test_the_first_camera_stays_where_only_products_can_be_seen(sequence: Sequence) -> None:
    scene = sequence.scene
    assert with_fixed_gauge(scene, CALIBRATION).locked_cameras == ("left",)
    for held in ({"base_frames": False}, {"extrinsics": False}, {"locked_cameras": ("right",)}):
        free = replace(CALIBRATION, **held)
        assert with_fixed_gauge(scene, free) == free


def test_pose_deviations_do_not_depend_on_where_a_camera_is_mounted(
    sequence: Sequence, frames: list[Frame], predictor: NumberedTruths
) -> None:
    scene, T_mount_world = sequence.scene, rigid([0.0, 90.0, 20.0], [50.0, 0.0, 20.0])
    cameras = (replace(one, T_camera_world=one.T_camera_world @ np.linalg.inv(T_mount_world)) for one in scene.cameras)
    mounts = {camera.name: T_mount_world for camera in scene.cameras}
    mounted = replace(scene, cameras=tuple(cameras)), [replace(frame, mounts=mounts) for frame in frames[:3]]
    found = []
    for given in ((scene, frames[:3]), mounted):
        optimizer = CalibrationOptimizer(*given, predictor, settings=replace(SETTINGS, stages=(FAR, Descend(2.0))))
        list(optimizer)
        found.append(optimizer.result().deviations["PSM1", "left"])
    assert astuple(found[0]) == pytest.approx(astuple(found[1]), rel=0.02)


def test_cancelling_keeps_the_best(sequence: Sequence, frames: list[Frame], predictor: NumberedTruths) -> None:
    optimizer = CalibrationOptimizer(with_wrong_base(sequence.scene), frames[:1], predictor, settings=SETTINGS)
    first, second = optimizer.step(), optimizer.step()
    optimizer.cancel()
    assert optimizer.step() is None and optimizer.stop_reason == "cancelled"
    assert first is not None and second is not None and second.loss < first.loss
    assert optimizer.best is second and optimizer.result().scene is second.scene


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"free": FreeParameters()}, "no calibration parameter is free"),
        ({"settings": DescentSolver()}, "requires the solver `surface`"),
        ({"joint_prior_deg": 0.0}, "joint_prior_deg is 0.0"),
        (
            {"free": FreeParameters(joints=False, extrinsics=True, locked_cameras=("left", "right"))},
            "no parameter is free",
        ),
        ({"frames": []}, "no frame was given"),
        ({"free": replace(CALIBRATION, locked_cameras=("third",))}, "there is no camera 'third'"),
    ],
)
def test_invalid_calibrations_are_refused(
    sequence: Sequence, frames: list[Frame], predictor: NumberedTruths, changes: dict, message: str
) -> None:
    with pytest.raises(CartsError, match=message):
        CalibrationOptimizer(sequence.scene, changes.pop("frames", frames), predictor, **changes)
