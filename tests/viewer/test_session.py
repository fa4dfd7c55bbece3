"""Frames, their poses, and what a project must keep of them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.errors import CartsError
from carts_core.project import Key, Kind, Project, Provenance, Source
from carts_core.recording import Sequence
from carts_viewer.editing import People
from carts_viewer.session import Session
from carts_viewer.state import Pose

HAND = Provenance(Source.HAND)


@pytest.fixture
def session(tiny_sequence: Callable[..., Path]) -> Session:
    sequence = Sequence.open(tiny_sequence(cameras=("left", "right"), domains=("regular", "smoke")))
    return Session(sequence, People(Project.open(sequence)))


def _pose(session: Session, index: int, camera: str = "left", domain: str = "regular") -> Pose:
    return session.pose(session.frame(index, domain, camera))


def _first_joint(session: Session, index: int, camera: str = "left", domain: str = "regular") -> float:
    return float(session.joints(_pose(session, index, camera, domain).scene)["PSM1"][0])


def _correct(session: Session, index: int, value: float, provenance: Provenance = HAND) -> None:
    frame = session.frame(index, "regular", "left")
    scene = session.with_joint(session.pose(frame).scene, "PSM1", 0, value)
    session.editor.project.apply("Correct", session.edits(frame, scene, provenance))


def test_a_frame_starts_at_its_measured_joints(session: Session) -> None:
    pose = _pose(session, 1)
    assert pose.source is Source.MEASURED
    assert session.joints(pose.scene)["PSM1"] == pytest.approx(session.sequence.measured["PSM1"][1], abs=1e-6)


def test_a_correction_is_of_its_frame_in_every_camera_and_domain(session: Session) -> None:
    _correct(session, 1, 0.25)
    assert _first_joint(session, 1) == pytest.approx(0.25)
    assert _first_joint(session, 1, "right", "smoke") == pytest.approx(0.25)
    assert _first_joint(session, 0) != pytest.approx(0.25)


def test_a_pose_that_is_as_measured_needs_no_correction(session: Session) -> None:
    _correct(session, 1, 0.25)
    frame = session.frame(1, "regular", "left")
    assert session.edits(frame, session.measured(frame), HAND) == {Key.joints(1, "PSM1"): None}


def test_a_pose_that_is_as_saved_keeps_who_made_it(session: Session) -> None:
    optimizer = Provenance.made_by_optimizer({}, "0" * 64)
    _correct(session, 1, 0.25, optimizer)
    frame = session.frame(1, "regular", "left")
    edits = session.edits(frame, session.pose(frame).scene, HAND)
    assert edits[Key.joints(1, "PSM1")].provenance == optimizer and len(edits) == 1
    assert session.pose(frame).source is Source.OPTIMIZER


def test_a_corrected_calibration_holds_in_every_frame(session: Session) -> None:
    frame = session.frame(1, "regular", "left")
    state = session.pose(frame).scene
    extrinsics, intrinsics, bases = state.T_camera_world.clone(), state.intrinsics.clone(), state.T_world_base.clone()
    extrinsics[1, 0, 3] += 0.01
    intrinsics[0, 0] += 5.0
    bases[0, 1, 3] += 0.02
    moved = replace(state, T_camera_world=extrinsics, intrinsics=intrinsics, T_world_base=bases)
    edits = session.edits(frame, moved, HAND)
    assert {key.name for key in edits if key.kind in (Kind.EXTRINSICS, Kind.INTRINSICS)} == {"right", "left"}
    session.editor.project.apply("Calibrate", edits)
    other = _pose(session, 0).scene
    assert torch.equal(other.T_camera_world, extrinsics) and torch.equal(other.T_world_base, bases)
    assert torch.equal(other.intrinsics, intrinsics)


def test_a_copied_correction_moves_the_measured_joints_by_as_much(session: Session) -> None:
    measured = session.sequence.measured["PSM1"]
    _correct(session, 0, measured[0][0] + 0.07)
    frames = [session.sequence.frame(index) for index in (1, 0)]
    copied = session.joints(session.copied(*frames))["PSM1"]
    assert copied - measured[1] == pytest.approx([0.07, *[0.0] * 6], abs=1e-6)
    with pytest.raises(CartsError, match="Frame 002 is as measured"):
        session.copied(*frames[::-1])


@pytest.mark.parametrize("value", [1e6, -1e6])
def test_a_joint_cannot_leave_its_limits(session: Session, value: float) -> None:
    limits = session.ranges["PSM1"][0]
    moved = session.joints(session.with_joint(_pose(session, 0).scene, "PSM1", 0, value))["PSM1"][0]
    assert moved == pytest.approx(limits.upper if value > 0 else limits.lower, abs=1e-6)


def test_a_perturbation_moves_every_joint_by_the_same_amount_and_repeats_with_its_seed(session: Session) -> None:
    start = session.pose(session.frame(0, "regular", "left")).scene
    first, again, other = (session.joints(session.perturbed(start, 0, 2.0, seed))["PSM1"] for seed in (5, 5, 6))
    difference = np.abs(first - session.joints(start)["PSM1"])
    revolute = [kind == "revolute" for kind in session.scene.arms[0].robot.joint_types]
    assert difference == pytest.approx(np.where(revolute, np.radians(2.0), 2e-3), abs=1e-6)
    assert np.array_equal(first, again) and not np.array_equal(first, other)
