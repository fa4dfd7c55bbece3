"""Frames, their poses, and what undo takes back."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from carts_core.data import Sequence
from carts_viewer.session import Session
from carts_viewer.state import Pose, Source


@pytest.fixture
def session(tiny_sequence: Callable[..., Path]) -> Session:
    return Session(Sequence.open(tiny_sequence(cameras=("left", "right"), domains=("regular", "smoke"))))


def _moved(session: Session, index: int, value: float) -> Pose:
    pose = session.pose(session.frame(index, "regular", "left"))
    return Pose(session.with_joint(pose.scene, "PSM1", 0, value), Source.EDITED)


def _first_joint(session: Session, index: int, camera: str = "left", domain: str = "regular") -> float:
    pose = session.pose(session.frame(index, domain, camera))
    return float(session.joints(pose.scene)["PSM1"][0])


def test_a_frame_starts_at_its_measured_joints(session: Session) -> None:
    pose = session.pose(session.frame(1, "regular", "left"))
    assert pose.source is Source.MEASURED
    assert session.joints(pose.scene)["PSM1"] == pytest.approx(session.sequence.measured["PSM1"][1], abs=1e-6)


def test_a_correction_is_remembered_for_its_frame_in_every_camera_and_domain(session: Session) -> None:
    session.correct(1, _moved(session, 1, 0.25))
    assert _first_joint(session, 1) == pytest.approx(0.25)
    assert _first_joint(session, 1, "right", "smoke") == pytest.approx(0.25)
    assert _first_joint(session, 0) != pytest.approx(0.25)


@pytest.mark.parametrize("value", [1e6, -1e6])
def test_a_joint_cannot_leave_its_limits(session: Session, value: float) -> None:
    limits = session.joint_range("PSM1", 0)
    moved = session.joints(_moved(session, 0, value).scene)["PSM1"][0]
    assert moved == pytest.approx(limits.upper if value > 0 else limits.lower, abs=1e-6)


def test_undo_takes_back_one_change_at_a_time(session: Session) -> None:
    before = _first_joint(session, 0)
    session.correct(0, _moved(session, 0, 0.1))
    session.correct(0, _moved(session, 0, 0.2))
    assert session.undo() == 0 and _first_joint(session, 0) == pytest.approx(0.1)
    assert session.undo() == 0 and _first_joint(session, 0) == pytest.approx(before)
    assert session.undo() is None


def test_the_events_of_one_drag_are_one_step_of_undo(session: Session) -> None:
    before = _first_joint(session, 0)
    for value in (0.1, 0.11, 0.12):
        session.correct(0, _moved(session, 0, value), merges="drag")
    assert session.undoable == 1
    session.undo()
    assert _first_joint(session, 0) == pytest.approx(before)


def test_undo_knows_on_which_frame_the_change_was(session: Session) -> None:
    session.correct(2, _moved(session, 2, 0.1))
    session.correct(0, _moved(session, 0, 0.1))
    assert [session.undo(), session.undo()] == [0, 2]


def test_a_perturbation_moves_every_joint_by_the_same_amount_and_repeats_with_its_seed(session: Session) -> None:
    start = session.pose(session.frame(0, "regular", "left")).scene
    first, again, other = (session.joints(session.perturbed(start, 0, 2.0, seed))["PSM1"] for seed in (5, 5, 6))
    difference = np.abs(first - session.joints(start)["PSM1"])
    revolute = [kind == "revolute" for kind in session.scene.arms[0].robot.joint_types]
    assert difference == pytest.approx(np.where(revolute, np.radians(2.0), 2e-3), abs=1e-6)
    assert np.array_equal(first, again) and not np.array_equal(first, other)
