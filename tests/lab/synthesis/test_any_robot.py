"""A robot that is no instrument, a metre and more away."""

from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.errors import SettingsError
from carts_core.evaluation import dice
from carts_core.lab.benchmark.hand_eye import ARM
from carts_core.lab.synthesis import EndoscopeConfig, MotionConfig, RenderConfig, SynthesisConfig, synthesize
from carts_core.recording import Sequence
from carts_core.rendering import Renderer

DISTANCE = 1.6


def _config(robot: Path, **settings) -> SynthesisConfig:
    return SynthesisConfig(
        seed=4,
        robot=robot,
        domains=("regular", "smoke"),
        endoscope=EndoscopeConfig(width=96, height=72, distance=DISTANCE),
        motion=MotionConfig(frames=2, frame_rate=2.0),
        render=RenderConfig(samples=1, tissue_resolution=64, texture_resolution=128),
        **settings,
    )


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    folder = tmp_path_factory.mktemp("arm")
    return Sequence.open(synthesize(_config(ARM), folder / "sequence"))


def test_one_arm_is_seen_from_so_far_and_its_masks_are_those_of_the_true_joints(sequence: Sequence) -> None:
    (arm,) = sequence.scene.arms
    renderer = Renderer(sequence.scene)
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        assert frame.masks is not None and frame.truth is not None
        assert 0.02 < frame.masks["left"].mean() < 0.6
        true, measured = (
            dice(renderer.segment(sequence.scene.state(joints))[0] >= 0, frame.masks["left"])
            for joints in (frame.truth, frame.measured)
        )
        assert true > 0.97 and measured < true
        assert (np.abs(frame.truth["arm"] - frame.measured["arm"]) > 0.005).all()
        low, high = arm.robot.joint_limits.numpy().T
        assert (frame.truth["arm"] > low).all() and (frame.truth["arm"] < high).all()
        T_camera_base = sequence.scene.cameras[0].T_camera_world @ arm.T_world_base
        tip = arm.robot.forward_kinematics(torch.from_numpy(frame.truth["arm"]))[-1].numpy()
        assert 0.5 * DISTANCE < (T_camera_base @ tip)[2, 3] < 1.4 * DISTANCE, "in metres, and not in the small world's"


def test_an_instrument_is_not_looked_at_from_a_metre_away(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"surgical instrument\. The limit for instruments is 0\.3 m"):
        synthesize(_config(SynthesisConfig().robot), tmp_path / "sequence")
