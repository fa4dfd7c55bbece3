"""Silhouettes and given masks that are far apart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import roma
import torch

from carts_core.lab.benchmark.hand_eye import ARM, looking_at
from carts_core.model.camera import Camera
from carts_core.model.robot import Robot
from carts_core.model.scene import Arm, Scene
from carts_core.optimization import CalibrationOptimizer, FreeParameters, MaskPredictor, Verdict
from carts_core.optimization.frame_problem import mask_distances, search_silhouettes, silhouette_distance
from carts_core.recording import Frame
from carts_core.rendering import Renderer
from carts_core.settings.stages import SilhouetteSearch

SIZE = (320, 240)


def square(left: int) -> np.ndarray:
    mask = np.zeros((1, 20, 60), bool)
    mask[:, 5:15, left : left + 10] = True
    return mask


def test_the_distance_of_equal_silhouettes_is_nothing_and_grows_where_they_do_not_overlap() -> None:
    everywhere = np.ones((1, 20, 60), bool)
    moved = np.stack([square(left) for left in (5, 8, 20, 35, 50)])
    found = silhouette_distance(moved, square(5), everywhere)
    assert found[0] == 0 and (np.diff(found) > 0).all()
    assert found[3] - found[2] == pytest.approx(15.0, abs=0.5)


def test_nothing_in_view_is_as_far_as_can_be_and_ignored_pixels_do_not_count() -> None:
    nothing = np.zeros((1, 1, 20, 60), bool)
    everywhere = np.ones((1, 20, 60), bool)
    assert silhouette_distance(nothing, square(5), everywhere)[0] == 60
    assert (mask_distances(nothing) == 60).all()
    left_half = everywhere.copy()
    left_half[..., 30:] = False
    both = square(5) | square(45)
    assert silhouette_distance(both[None], square(5), left_half)[0] == 0


def test_a_search_finds_what_lies_several_deviations_off() -> None:
    wanted = torch.tensor([2.0, -1.5, 0.5])
    found = search_silhouettes(
        lambda trials: 10 * (trials - wanted).square().sum(1).sqrt().numpy(),
        torch.ones(3),
        lambda trials: trials,
        SilhouetteSearch(starts=1, enough=0.0),
    )
    assert (found - wanted).abs().max() < 0.1


def arm_before_camera(folder: Path) -> tuple[Scene, list[Frame]]:
    """The seven-joint arm in four poses; images are black, masks exact."""
    T = looking_at(np.array([1.7, 0.3, 0.8]), np.array([0.0, 0.0, 0.5]))
    camera = Camera(
        name="left", width=SIZE[0], height=SIZE[1], intrinsics=(310.0, 310.0, 160.0, 120.0), T_camera_world=T
    )
    scene = Scene((Arm("arm", Robot.load(ARM), np.eye(4)),), (camera,))
    renderer, rng = Renderer(scene), np.random.default_rng(0)
    frames = []
    for index in range(4):
        joints = {"arm": rng.uniform(-1.2, 1.2, 7)}
        mask = renderer.segment(scene.state(joints))[0] >= 0
        image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        frames.append(Frame(index, f"{index:03d}", "regular", {"left": image}, joints, joints, {"left": mask}, None))
    return scene, frames


def test_hand_eye_from_masks_finds_a_base_frame_30_degrees_and_20_centimetres_off(tmp_path: Path) -> None:
    scene, frames = arm_before_camera(tmp_path)
    (arm,) = scene.arms
    rng = np.random.default_rng(0)
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    off = np.eye(4)
    off[:3, :3] = roma.rotvec_to_rotmat(torch.tensor(np.radians(30) * axis)).numpy()
    off[:3, 3] = 0.2 * direction
    wrong = replace(scene, arms=(replace(arm, T_world_base=arm.T_world_base @ off),))
    free = FreeParameters(joints=False, base_frames=True)
    optimizer = CalibrationOptimizer(wrong, frames, MaskPredictor(), free=free)
    list(optimizer)
    left = np.linalg.inv(arm.T_world_base) @ optimizer.result().scene.arms[0].T_world_base
    assert float(roma.rotmat_to_rotvec(torch.tensor(left[:3, :3])).norm().rad2deg()) < 0.3
    assert np.linalg.norm(left[:3, 3]) < 0.003
    assert optimizer.assessment is not None and optimizer.assessment.verdict is Verdict.GOOD
