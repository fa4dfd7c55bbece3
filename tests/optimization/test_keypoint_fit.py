"""Joint positions from points that were found in the image."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny import TinyScene, tiny_scene

from carts_core.errors import RobotError, SettingsError
from carts_core.model.keypoints import Pin, keypoints, project_keypoints
from carts_core.model.perturbation import perturb
from carts_core.model.robot import Robot
from carts_core.optimization.keypoints import KeypointSettings, fit_keypoints

TRUTH = np.array([0.1, -0.05, 0.16, 0.4, 0.3, -0.3, 0.4])
"""[rad, m]; no joint at a limit, and a bent wrist, so that its joints can be distinguished."""


@pytest.fixture
def tiny(shipped_psm: Robot) -> TinyScene:
    return tiny_scene(shipped_psm, 1, ("left", "right"), 640, 480)


def _pins(tiny: TinyScene, camera: str = "left", count: int = 4) -> list[Pin]:
    points = keypoints(tiny.scene.arms[0])[:count]
    pixels = project_keypoints(tiny.scene, tiny.scene.state({"PSM1": TRUTH}), points, camera).tolist()
    return [Pin(point, camera, (u, v)) for point, (u, v) in zip(points, pixels, strict=True)]


def _perturbed(tiny: TinyScene, degrees: float, seed: int):
    return tiny.scene.state(perturb(tiny.scene, {"PSM1": TRUTH}, degrees, seed))


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("cameras", [("left",), ("left", "right")])
def test_four_exact_keypoints_determine_the_joints(tiny: TinyScene, seed: int, cameras: tuple[str, ...]) -> None:
    pins = [pin for camera in cameras for pin in _pins(tiny, camera)]
    fit = fit_keypoints(tiny.scene, _perturbed(tiny, 2.0, seed), pins)
    error = fit.state.joint_positions[0] - TRUTH
    assert np.abs(np.degrees(np.delete(error, 2))).max() < 0.1 and abs(error[2]) < 1e-4
    assert max(fit.residuals) < 0.05 and len(fit.residuals) == len(pins)


def test_one_pin_is_met_and_joints_move_no_more_than_they_need(tiny: TinyScene) -> None:
    start = _perturbed(tiny, 2.0, 0)
    fit = fit_keypoints(tiny.scene, start, _pins(tiny, count=1))
    moved = fit.state.joint_positions[0] - start.joint_positions[0].numpy()
    assert fit.residuals[0] < 0.05
    assert np.abs(np.degrees(np.delete(moved, 2))).max() < 4.0


def test_joints_stay_within_their_limits_when_a_pin_is_out_of_reach(tiny: TinyScene) -> None:
    points = keypoints(tiny.scene.arms[0])
    pins = [Pin(points[0], "left", (0.0, 0.0)), Pin(points[-1], "left", (640.0, 480.0))]
    fit = fit_keypoints(tiny.scene, _perturbed(tiny, 2.0, 0), pins, KeypointSettings(prior_deg=100.0))
    low, high = tiny.scene.arms[0].robot.joint_limits.T
    values = fit.state.joint_positions[0]
    assert ((values >= low - 1e-6) & (values <= high + 1e-6)).all()
    assert max(fit.residuals) > 1.0


def test_what_cannot_be_solved_is_refused_with_the_reason(tiny: TinyScene) -> None:
    start = _perturbed(tiny, 2.0, 0)
    with pytest.raises(SettingsError, match="no keypoint is placed"):
        fit_keypoints(tiny.scene, start, [])
    behind = replace(start, T_camera_world=torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ start.T_camera_world)
    with pytest.raises(SettingsError, match="behind its camera"):
        fit_keypoints(tiny.scene, behind, _pins(tiny))
    with pytest.raises(RobotError, match="there is no camera 'top'"):
        fit_keypoints(tiny.scene, start, [replace(_pins(tiny)[0], camera="top")])
    with pytest.raises(SettingsError, match="prior_deg is 0"):
        KeypointSettings(prior_deg=0)
