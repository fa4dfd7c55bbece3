"""Edits, undo and redo: state of a project, and refused edits."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from project_model import HAND, IDENTITY, OPTIMIZER, visible

from carts_core.errors import ProjectError
from carts_core.project import (
    Change,
    CorrectedIntrinsics,
    CorrectedTransform,
    Figures,
    IgnoreRegion,
    JointCorrection,
    Key,
    Keyframe,
    MaskCorrection,
    Project,
    Provenance,
    Review,
    ReviewState,
    Source,
)

JOINTS = JointCorrection((0.1, 0.2, 0.03), HAND)
ACCEPTED = Review(ReviewState.ACCEPTED, "clean")


def test_values_keep_every_bit_and_who_made_them(project: Project, project_path: Path) -> None:
    positions = np.random.default_rng(0).normal(size=3)
    correction = JointCorrection(positions, OPTIMIZER, np.array([1e-5, np.inf, np.nan]))  # pyright: ignore[reportArgumentType]
    project.apply("Optimize", {Key.joints(0, "PSM1"): correction})
    project.close()
    with Project(IDENTITY, project_path, read_only=True) as again:
        found = again.state.joints(0)["PSM1"]
    assert np.array_equal(found.joint_positions, positions)
    assert found.standard_deviations == (1e-5, None, None)
    assert found.provenance == OPTIMIZER


def test_a_gesture_over_many_frames_is_one_step_of_undo_even_after_a_restart(tmp_path: Path) -> None:
    identity = replace(IDENTITY, frame_ids=tuple(f"{index:04d}" for index in range(200)))
    propagated = JointCorrection((0.1, 0.2, 0.03), Provenance(Source.PROPAGATED))
    with Project(identity, tmp_path / "long.carts") as project:
        project.apply("Hand-seed", {Key.joints(0, "PSM1"): JOINTS})
        project.apply("Solve between", {Key.joints(frame, "PSM1"): propagated for frame in range(1, 200)})
    with Project(identity, tmp_path / "long.carts") as project:
        change = project.undo()
        assert change is not None and change.step is not None
        assert change.step.name == "Solve between" and change.frames == tuple(range(1, 200))
        assert [frame for frame in range(200) if project.state.joints(frame)] == [0]
    with Project(identity, tmp_path / "long.carts") as project:
        assert project.state.redoable is not None
        project.redo()
        assert all(project.state.joints(frame) for frame in range(200))


def test_hand_made_frames_are_keyframes_unless_somebody_says_otherwise(project: Project) -> None:
    project.apply("Optimize", {Key.joints(0, "PSM1"): replace(JOINTS, provenance=OPTIMIZER)})
    assert not project.state.is_keyframe(0)
    project.apply("Drag", {Key.joints(0, "PSM2"): JointCorrection((0.0, 0.0), HAND)})
    assert project.state.is_keyframe(0)
    project.apply("Release", {Key.keyframe(0): Keyframe(False)})
    assert not project.state.is_keyframe(0)
    project.apply("Hold", {Key.keyframe(1): Keyframe(True)})
    assert project.state.is_keyframe(1)


def test_figures_that_come_too_late_are_not_given_to_another_state(project: Project) -> None:
    project.apply("Drag", {Key.joints(0, "PSM1"): JOINTS})
    old = project.state
    project.undo()
    project.apply("Drag elsewhere", {Key.joints(0, "PSM1"): replace(JOINTS, joint_positions=(0, 0, 0))})
    project.record_figures({0: Figures(loss=0.5), 1: Figures(loss=0.25)}, old)
    assert project.state.figures(0) is None
    assert project.state.figures(1) == Figures(loss=0.25)


def test_layers_come_back_pixel_for_pixel(project: Project, project_path: Path) -> None:
    rng = np.random.default_rng(2)
    added, ignored, rendered = (rng.random((3, 6, 8)) < 0.5).astype(bool)
    removed = ~added & (rng.random((6, 8)) < 0.5)
    layers = {
        Key.mask_correction(2, "left"): MaskCorrection.of(added, removed),
        Key.ignore_region(2, "left"): IgnoreRegion.of(ignored),
    }
    project.apply("Paint", layers)
    project.close()
    with Project(IDENTITY, project_path) as again:
        mask = again.state.get(Key.mask_correction(2, "left"))
        region = again.state.get(Key.ignore_region(2, "left"))
    assert mask is not None and region is not None
    assert np.array_equal(mask.added(), added) and np.array_equal(mask.removed(), removed)
    assert np.array_equal(mask.applied_to(rendered), (rendered | added) & ~removed)
    assert np.array_equal(region.region(), ignored)


def test_listeners_hear_of_every_save_after_it_is_done_and_cannot_spoil_it(project: Project) -> None:
    heard: list[tuple[str, tuple[int, ...], str]] = []

    def listener(change: Change) -> None:
        heard.append((change.action, change.frames, project.state.review(1).note))
        raise RuntimeError("a broken listener")

    forget = project.listen(listener)
    project.apply("Note", {Key.review(1): Review(note="a"), Key.base_frame("PSM1"): None})
    project.undo()
    project.redo()
    project.record_figures({2: Figures(loss=0.1)}, project.state)
    project.log_export("csv", Path("k.csv"), 1, {})
    forget()
    project.undo()
    actions = ["apply", "undo", "redo", "figures", "export"]
    assert heard == list(zip(actions, [(1,), (1,), (1,), (2,), ()], ["a", "", "a", "a", "a"], strict=True))


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (Key.joints(3, "PSM1"), JOINTS, "no frame number 3; its frames are 0 to 2"),
        (Key.joints(-1, "PSM1"), JOINTS, "no frame number -1"),
        (Key.joints(0, "PSM9"), JOINTS, "no arm 'PSM9' for joints; its arms are: PSM1, PSM2"),
        (Key.joints(0, "PSM2"), JOINTS, "arm 'PSM2' has 2 joints .yaw, pitch., but 3 joint positions were given"),
        (Key.joints(0, "PSM1"), ACCEPTED, "joints must be a JointCorrection, not a Review"),
        (Key.intrinsics("right"), None, "no camera 'right' for intrinsics; its cameras are: left"),
        (Key.ignore_region(0, "left"), IgnoreRegion.of(np.ones((4, 4), bool)), "4 x 4 pixels, .* 'left' have 8 x 6"),
        (replace(Key.base_frame("PSM1"), frame=0), None, "applies to all frames"),
    ],
)
def test_invalid_edits_are_refused_as_a_whole(project: Project, key: Key, value: object, message: str) -> None:
    with pytest.raises(ProjectError, match=message):
        project.apply("Wrong", {Key.review(0): ACCEPTED, key: value})
    assert project.history() == () and project.state.review(0) == Review()


@pytest.mark.parametrize(
    "make",
    [
        lambda: JointCorrection((0.0, float("nan")), HAND),
        lambda: JointCorrection(("a", "b"), HAND),  # pyright: ignore[reportArgumentType]
        lambda: JointCorrection((0.0, 1.0), HAND, (0.1,)),
        lambda: JointCorrection((0.0, 1.0), HAND, (0.1, -0.1)),
        lambda: CorrectedTransform(tuple(map(tuple, 2 * np.eye(4))), HAND),
        lambda: CorrectedIntrinsics((0.0, 800.0, 4.0, 3.0), HAND),
        lambda: Provenance(Source.OPTIMIZER),
        lambda: Provenance(Source.HAND, settings="{"),
        lambda: Provenance("nobody"),  # pyright: ignore[reportArgumentType]
        lambda: Provenance(Source.PROPAGATED, weights_sha256="abc"),
        lambda: Review("perfect"),  # pyright: ignore[reportArgumentType]
        lambda: Review(note="x" * 10_001),
        lambda: Figures(loss=float("inf")),
        lambda: MaskCorrection.of(np.ones((2, 2), bool), np.ones((2, 2), bool)),
        lambda: IgnoreRegion.of(np.ones((2, 2, 3), bool)),
        lambda: IgnoreRegion(b"GIF89a"),
    ],
)
def test_impossible_values_cannot_be_made(make) -> None:
    with pytest.raises(ProjectError):
        make()


@pytest.mark.parametrize("name", ["", "  \n"])
def test_a_step_needs_a_name(project: Project, name: str) -> None:
    with pytest.raises(ProjectError, match="an empty name"):
        project.apply(name, {Key.review(0): ACCEPTED})


def test_a_long_name_of_a_step_is_shortened_and_the_edit_saved(project: Project) -> None:
    project.apply("x" * 201, {Key.review(0): ACCEPTED})
    assert project.state.steps[-1].name == "x" * 199 + "…"


def test_a_closed_project_takes_no_edits_but_can_still_be_read(project: Project) -> None:
    project.apply("Accept", {Key.review(0): ACCEPTED})
    project.close()
    project.close()
    for attempt in (lambda: project.apply("Reject", {Key.review(0): None}), project.undo):
        with pytest.raises(ProjectError, match="It was closed"):
            attempt()
    assert project.state.review(0) == ACCEPTED and not project.writable


def test_edits_from_several_threads_are_all_kept_one_after_the_other(project: Project, project_path: Path) -> None:
    def edit(frame: int) -> None:
        for number in range(25):
            project.apply(f"{frame} {number}", {Key.review(frame): Review(note=str(number))})
            project.record_figures({frame: Figures(loss=float(number))}, project.state)

    threads = [threading.Thread(target=edit, args=(frame,)) for frame in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(project.history()) == 75
    expected = visible(project.state)
    project.close()
    with Project(IDENTITY, project_path) as again:
        assert visible(again.state) == expected
        for frame in range(3):
            own = [step.name for step in again.history() if step.name.startswith(f"{frame} ")]
            assert own == [f"{frame} {number}" for number in range(25)]
            assert again.state.review(frame).note == "24" and again.state.figures(frame) == Figures(loss=24.0)


def test_one_step_is_taken_back_and_later_ones_stay(project: Project) -> None:
    project.apply("Drag", {Key.joints(0, "PSM1"): JOINTS})
    project.apply("Accept", {Key.review(1): ACCEPTED})
    project.apply("Undo: Drag", *project.reverting(1))
    assert not project.state.joints(0) and project.state.review(1) == ACCEPTED
    # What took it back is a step like any other, and what it set is what is taken back now.
    project.apply("Redo: Drag", *project.reverting(3))
    assert project.state.joints(0) == {"PSM1": JOINTS}
    # Step 1 and step 4 have set the same, so nothing has changed it since.
    assert project.reverting(1) == ({Key.joints(0, "PSM1"): None}, {})


def test_a_step_whose_values_were_changed_since_is_not_taken_back(project: Project) -> None:
    project.apply("Accept", {Key.review(1): ACCEPTED})
    project.apply("Reject", {Key.review(1): Review(ReviewState.REJECTED)})
    with pytest.raises(ProjectError, match=r"step 1 \(Accept\) cannot be reverted alone: step 2 \(Reject\)"):
        project.reverting(1)
    with pytest.raises(ProjectError, match="step 3 is not in effect; the last step in effect is 2"):
        project.reverting(3)
