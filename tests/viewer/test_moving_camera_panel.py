"""The viewer of a recording whose camera moves."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from moving import let_camera_move, swing
from viewer_desk import Desk

from carts_core.evaluation.evaluate import dice
from carts_core.project import CorrectedTransform, Key, Project, Provenance, Source
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory, scene_at

FRAMES = 4


@pytest.fixture
def moving(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Desk:
    path = let_camera_move(tiny_sequence(frames=FRAMES, width=160, height=120), swing(FRAMES, 3.0, 0.002))
    sequence = Sequence.open(path)
    return Desk(sequence, Project.open(sequence), OptimizerFactory(weights=(untrained_weights,), report=lambda _: None))


def overlap(desk: Desk) -> float:
    """Of the overlay at the true joints with the mask of the frame."""
    frame = desk.state.frame
    assert frame.truth is not None and frame.masks is not None
    pose = desk.session.with_joints(desk.state.pose.scene, frame.truth)
    return dice(desk.renderer.mask(pose, "left"), frame.masks["left"])


def test_the_overlay_follows_the_camera_from_frame_to_frame(moving: Desk) -> None:
    for index in range(FRAMES):
        moving.do(intents.ShowFrame(index))
        assert overlap(moving) > 0.98
    seen = moving.state.pose.scene.T_view_world[0].numpy()
    moving.do(intents.ShowFrame(1))
    assert np.abs(moving.state.pose.scene.T_view_world[0].numpy() - seen).max() > 1e-3


def test_a_correction_of_the_camera_is_one_of_its_place_on_the_mount_in_all_frames(moving: Desk) -> None:
    shift = np.eye(4)
    shift[:3, 3] = 0.001, 0.0, 0.002
    corrected = shift @ moving.session.scene.cameras[0].T_camera_world
    value = CorrectedTransform(tuple(map(tuple, corrected.tolist())), Provenance(Source.HAND))
    moving.session.editor.project.apply("Move the camera", {Key.extrinsics("left"): value})
    for index in (1, 3):
        moving.do(intents.ShowFrame(index))
        state = moving.state.pose.scene
        wanted = corrected @ moving.session.sequence.mounts(index)["left"]
        np.testing.assert_allclose(state.T_view_world[0].numpy(), wanted, atol=1e-6)
        # Moving a joint by hand changes no calibration.
        before = moving.saved.get(Key.extrinsics("left"))
        moving.do(intents.SetJoint("PSM1", 0, 0.02), intents.Released())
        assert moving.saved.get(Key.extrinsics("left")) == before
        scene = scene_at(moving.session.scene, state)
        np.testing.assert_allclose(scene.cameras[0].T_camera_world, corrected, atol=1e-6)


def test_a_run_that_does_not_free_the_camera_leaves_it_where_it_is(moving: Desk) -> None:
    moving.do(intents.ShowFrame(1))
    before = moving.state.pose.scene
    moving.do(intents.Step(), intents.Pause())
    after = moving.state.pose.scene
    assert torch.equal(before.T_mount_world, after.T_mount_world)
    assert torch.equal(before.T_camera_world, after.T_camera_world)
    assert moving.saved.get(Key.extrinsics("left")) is None
