"""Solving between keyframes, with the real optimizer and the shipped network."""

import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError, ProjectError
from carts_core.evaluation.metrics import dice
from carts_core.optimization import SequenceOptimizer, SurfaceSolver
from carts_core.project import (
    CorrectedIntrinsics,
    CorrectedTransform,
    IgnoreRegion,
    Key,
    Keyframe,
    MaskCorrection,
    Provenance,
    ReviewState,
    Source,
)
from carts_viewer.actions import intents
from carts_viewer.actions.sequence import PropagatingHandler
from carts_viewer.jobs import comparison
from carts_viewer.panels.sequence import calibration_line

FRAMES = 5


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=FRAMES, width=128, height=96)


@pytest.fixture
def desk(recording: Path) -> Desk:
    return opened(recording)


def opened(recording: Path, project: Path | None = None) -> Desk:
    """A desk with the settings that a user begins with."""
    desk = Desk.open(recording, project=project)
    assert desk.do(intents.SetSetting("solver", "surface")).settings == SurfaceSolver()
    return desk


def hand_made(desk: Desk, *frames: int) -> dict[int, float]:
    """The first joint of these frames, put where the truth is by hand."""
    truth = desk.session.sequence.truth
    assert truth is not None
    for frame in frames:
        desk.do(
            intents.ShowFrame(frame), intents.SetJoint("PSM1", 0, float(truth["PSM1"][frame][0])), intents.Released()
        )
    return {frame: desk.saved.joints(frame)["PSM1"].joint_positions[0] for frame in frames}


def solve_some(desk: Desk, frames: int) -> None:
    """Advance until a number of frames are solved; some are visited before the first one."""
    assert desk.state.solve is not None
    while desk.state.solve.done < frames:
        desk.advance()
        assert desk.state.solve is not None and desk.state.solve.running


def sources(desk: Desk) -> list[Source | None]:
    """Source of each frame's joints."""
    found = [desk.saved.joints(frame).get("PSM1") for frame in range(FRAMES)]
    return [None if correction is None else correction.provenance.source for correction in found]


def hold_back(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Solve the first two frames, whose results count as worse and are not applied."""
    monkeypatch.setattr(comparison, "worse_than", lambda fit, other: "loss")
    desk.do(intents.SetRange((0, 1)), intents.Solve(whole=True))
    desk.finish()
    assert sources(desk) == [None] * FRAMES


def test_frames_between_keyframes_are_solved_in_one_step_and_keyframes_stay(desk: Desk) -> None:
    kept = hand_made(desk, 0, 3)
    desk.do(intents.ShowFrame(1), intents.Solve())
    assert desk.state.solving
    desk.finish()
    assert sources(desk) == [Source.HAND, Source.PROPAGATED, Source.PROPAGATED, Source.HAND, None]
    assert {frame: desk.saved.joints(frame)["PSM1"].joint_positions[0] for frame in kept} == kept
    solved = desk.saved.joints(1)["PSM1"]
    assert solved.standard_deviations is not None and min(value or 0.0 for value in solved.standard_deviations) > 0.0
    assert '"keyframes": [0, 3]' in (solved.provenance.settings or "")
    assert desk.saved.review(1).state is ReviewState.OPTIMIZED
    figures = desk.saved.figures(2)
    assert figures is not None and figures.loss is not None and figures.dice is not None
    assert desk.state.pose.source is Source.PROPAGATED
    assert desk.state.undoable == 3 and desk.state.project.steps[-1].name == "Solve 2 frames, 002 to 003"
    desk.do(intents.Undo())
    assert sources(desk) == [Source.HAND, None, None, Source.HAND, None]


def test_a_frame_without_the_image_of_one_camera_is_solved_and_compared_in_the_other(
    tiny_sequence: Callable[..., Path],
) -> None:
    def sparse(text: str) -> str:
        return text.replace('name = "right"', 'name = "right"\nsparse_images = true')

    path = tiny_sequence(frames=3, cameras=("left", "right"), width=128, height=96, edit=sparse)
    (path.parent / "regular" / "right" / "002.png").unlink()
    desk = opened(path)
    desk.do(intents.Solve(whole=True))
    desk.finish()
    assert desk.state.error is None and desk.state.solve is not None and desk.state.solve.listed == ()
    verdicts = [desk.saved.get(Key.verdict(frame)) for frame in range(3)]
    cameras = [None if verdict is None else [name for name, _ in verdict.cameras] for verdict in verdicts]
    assert cameras == [["left", "right"], [], ["left", "right"]]  # a verdict on one camera does not name it


def test_between_keyframes_is_inside_the_range_where_the_frame_lies_in_one(desk: Desk) -> None:
    desk.do(intents.SetRange((1, 3)), intents.ShowFrame(4), intents.SetReview(ReviewState.ACCEPTED))
    with pytest.raises(CartsError, match="no keyframe yet"):
        desk.do(intents.ShowFrame(2), intents.Solve())
    desk.do(intents.ShowFrame(1), intents.SetReview(ReviewState.ACCEPTED), intents.ShowFrame(2), intents.Solve())
    assert desk.state.solve is not None and desk.state.solve.frames == range(1, 4)
    seen = []
    while desk.state.solve.running:
        desk.advance()
        seen.append(desk.state.solve.progress)
    # The bar is full when all is done, and not when frames are still compared.
    assert seen == sorted(seen) and {(3, 6), (4, 6), (5, 6), (6, 6)} <= set(seen)
    assert sources(desk) == [None, None, Source.PROPAGATED, Source.PROPAGATED, None]


def test_solving_backwards_begins_at_the_last_frame_and_stopping_keeps_what_is_solved_as_one_step(desk: Desk) -> None:
    hand_made(desk, 0)
    desk.do(intents.SetDirection("backward"), intents.ShowFrame(2), intents.Solve())
    solve_some(desk, 2)
    state = desk.do(intents.StopSolving())
    assert not state.solving and state.solve is not None and state.solve.text.startswith("Stopped: 2 frames solved")
    assert sources(desk) == [Source.HAND, None, None, Source.PROPAGATED, Source.PROPAGATED] and state.undoable == 2
    assert desk.wait_time() is None


def test_a_freed_frame_is_solved_and_one_that_is_made_by_hand_meanwhile_is_not_overwritten(desk: Desk) -> None:
    hand_made(desk, 0, 1)
    desk.do(intents.SetKeyframe(False))
    assert desk.saved.get(Key.keyframe(1)) == Keyframe(False)
    desk.do(intents.SetKeyframe(), intents.SetKeyframe(), intents.Solve())
    solve_some(desk, 1)
    kept = hand_made(desk, 2)
    desk.finish()
    assert sources(desk) == [Source.HAND, Source.PROPAGATED, Source.HAND, *[Source.PROPAGATED] * 2]
    assert desk.saved.joints(2)["PSM1"].joint_positions[0] == kept[2]


def test_ignored_pixels_are_not_looked_at(desk: Desk) -> None:
    project = desk.session.editor.project
    everything = np.ones((96, 128), bool)
    project.apply("Ignore", {Key.ignore_region(frame, "left"): IgnoreRegion.of(everything) for frame in range(2)})
    desk.do(intents.SetRange((0, 1)), intents.Solve(whole=True))
    desk.finish()
    measured = desk.session.sequence.measured["PSM1"][:2]
    solved = [desk.saved.joints(frame)["PSM1"].joint_positions for frame in range(2)]
    assert np.abs(np.array(solved) - measured).max() < 1e-6


def test_an_image_that_is_missing_does_not_cost_the_frames_before_it(recording: Path) -> None:
    (recording.parent / "regular" / "left" / "005.png").write_bytes(b"no picture")
    desk = opened(recording)
    desk.do(intents.Solve(whole=True))
    with pytest.raises(CartsError, match=r"005\.png"):
        desk.finish()
    assert sources(desk) == [*[Source.PROPAGATED] * 4, None] and not desk.state.solving


def test_an_error_before_the_first_frame_leaves_nothing_solved(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("The disk is gone.")

    monkeypatch.setattr(PropagatingHandler, "_make", fail)
    with pytest.raises(OSError, match="The disk is gone"):
        desk.do(intents.Solve(whole=True))
    assert not desk.state.solving and desk.wait_time() is None and sources(desk) == [None] * FRAMES


def test_an_error_of_something_else_does_not_cost_what_is_solved(desk: Desk) -> None:
    desk.do(intents.Solve(whole=True))
    solve_some(desk, 1)
    desk.fail(CartsError("the export failed"))
    assert not desk.state.solving and sources(desk) == [Source.PROPAGATED, *[None] * 4]
    assert desk.state.error == "the export failed"


def test_what_cannot_be_solved_is_refused_with_the_reason(desk: Desk) -> None:
    with pytest.raises(CartsError, match="no keyframe yet"):
        desk.do(intents.Solve())
    with pytest.raises(CartsError, match="requires the solver"):
        desk.do(intents.SetSetting("solver", "acs"), intents.SetKeyframe(True), intents.Solve())
    with pytest.raises(ProjectError, match="could not be saved"):
        desk.reopened(read_only=True).do(intents.Solve(whole=True))


def test_a_run_waits_for_solving_and_a_new_calibration_ends_it(desk: Desk) -> None:
    desk.do(intents.Solve(whole=True))
    with pytest.raises(CartsError, match="being solved"):
        desk.do(intents.Run())
    project, camera = desk.session.editor.project, desk.session.scene.cameras[0]
    moved = CorrectedIntrinsics(tuple(value + 1 for value in camera.intrinsics), Provenance(Source.HAND))
    project.apply("Calibrate", {Key.intrinsics("left"): moved})
    with pytest.raises(CartsError, match="calibration was changed"):
        desk.finish()
    assert not desk.state.solving and sources(desk) == [None] * FRAMES


def test_frames_are_solved_with_the_calibration_at_the_start_of_their_job(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks, sequence = [], desk.factory.sequence
    monkeypatch.setattr(desk.factory, "sequence", lambda task: (tasks.append(task), sequence(task))[1])
    desk.do(intents.Export("csv", "All"), intents.SetRange((0, 1)), intents.Solve(whole=True))
    assert [job.state for job in desk.state.jobs] == ["running", "waiting"]
    intrinsics = tuple(value + 1 for value in desk.session.scene.cameras[0].intrinsics)
    moved = CorrectedIntrinsics(intrinsics, Provenance(Source.HAND))
    desk.session.editor.project.apply("Calibrate", {Key.intrinsics("left"): moved})
    while not tasks:
        desk.advance()
    assert tuple(tasks[0].state.intrinsics[0]) == intrinsics
    desk.do(intents.CancelJob(2))


def test_dice_of_a_solved_frame_is_that_of_its_corrected_mask(desk: Desk) -> None:
    project = desk.session.editor.project
    everything, nothing = np.ones((96, 128), bool), np.zeros((96, 128), bool)
    project.apply("Add to the mask", {Key.mask_correction(1, "left"): MaskCorrection.of(everything, nothing)})
    desk.do(intents.SetRange((0, 2)), intents.Solve(whole=True))
    desk.finish()
    masks = desk.session.sequence.frame(1, "regular", ["left"]).masks
    figures = [desk.saved.figures(frame) for frame in range(3)]
    assert masks is not None and all(figure is not None for figure in figures)
    found = [figure.dice for figure in figures if figure is not None]
    assert found[1] == pytest.approx(dice(everything, masks["left"]))
    assert min(value for value in (found[0], *found[2:]) if value is not None) > 0.8 > (found[1] or 0.0)


def test_a_suspicion_against_base_frames_is_said_when_frames_were_solved_until_the_calibration_changes(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said() -> str:
        assert desk.state.solve is not None
        return calibration_line(desk.state.solve.suspicion(desk.state.project))

    desk.do(intents.SetRange((0, 1)), intents.Solve(whole=True))
    desk.finish()
    assert desk.state.solve is not None and desk.state.solve.suspicion(desk.state.project) is not None
    assert said() == "", "the base frame is right"
    monkeypatch.setattr(SequenceOptimizer, "base_frame_gain", lambda self: 0.4)
    desk.do(intents.Solve(whole=True))
    desk.advance()
    assert said() == "", "not before the end"
    desk.finish()
    assert "residual would be 40 % smaller" in said()
    moved = desk.session.scene.arms[0].T_world_base.copy()
    moved[0, 3] += 0.01
    corrected = CorrectedTransform(tuple(map(tuple, moved.tolist())), Provenance(Source.HAND))
    desk.session.editor.apply("Move the base", {Key.base_frame("PSM1"): corrected})
    desk.do(intents.ShowFrame(1))
    assert said() == "", "it was about another calibration"


def test_a_solved_pose_is_taken_by_its_user_without_what_another_calibration_said_of_it(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold_back(desk, monkeypatch)
    desk.do(intents.TakeSolved(0))
    assert desk.saved.verdict(0) is not None and desk.saved.figures(0) is not None
    camera, editor = desk.session.scene.cameras[0], desk.session.editor
    moved = CorrectedIntrinsics(tuple(value + 1 for value in camera.intrinsics), Provenance(Source.HAND))
    other = editor.people.join()
    editor.people.apply(other, "Calibrate", {Key.intrinsics("left"): moved})
    desk.job_runner.handle(intents.TakeSolved(1), other, desk.state)
    assert sources(desk)[:2] == [Source.PROPAGATED] * 2
    assert desk.saved.verdict(1) is None and desk.saved.figures(1) is None
    # The other user's step is not undone.
    desk.do(intents.Undo())
    assert sources(desk)[:2] == [None, Source.PROPAGATED]


def test_a_solved_pose_that_could_not_be_saved_can_be_taken_again(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    hold_back(desk, monkeypatch)

    def fail(*_: object) -> None:
        raise ProjectError("The disk is full.")

    with monkeypatch.context() as full, pytest.raises(ProjectError, match="The disk is full"):
        full.setattr(desk.session.editor.people, "apply", fail)
        desk.do(intents.TakeSolved(0))
    assert sources(desk)[:2] == [None] * 2
    desk.do(intents.TakeSolved(0))
    assert sources(desk)[:2] == [Source.PROPAGATED, None]


@pytest.mark.parametrize("step", ["_make", "_take"])
def test_the_list_of_a_solve_is_used_as_before_when_another_one_cannot_be_started(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    hold_back(desk, monkeypatch)
    kept = hand_made(desk, 0)

    def fail(*_: object) -> None:
        raise CartsError("The solver is gone.")

    with monkeypatch.context() as gone, pytest.raises(CartsError, match="The solver is gone"):
        gone.setattr(PropagatingHandler, step, fail)
        desk.do(intents.Solve(whole=True))
    # The edited frame is not overwritten.
    with pytest.raises(CartsError, match="the frame was changed since"):
        desk.do(intents.TakeSolved(0))
    desk.do(intents.TakeSolved())
    assert sources(desk)[:2] == [Source.HAND, Source.PROPAGATED]
    assert desk.saved.joints(0)["PSM1"].joint_positions[0] == kept[0]


# ---- Random sets of keyframes ---------------------------------------------------------------------------------------

WORSE = 0.005
"""A frame is worse by this much less Dice with the true mask."""


class KeyframeSets:
    """Tries random sets of keyframes on one recording, each in a project of its own.

    Attributes:
        tally: frames that became `better`, `worse`, or worse without being listed (`silent`), and `refused` sets.
    """

    def __init__(self, recording: Path) -> None:
        self._recording, self.tally = recording, Counter[str]()

    def try_one(self, seed: int) -> None:
        """Correct, ruin and accept some frames, solve between or all, and compare every frame with how it was."""
        dice = random.Random(seed)
        desk = opened(self._recording, self._recording.with_name(f"set_{seed}.carts"))
        try:
            self._prepare(desk, dice)
            before = [self._overlap(desk, frame) for frame in range(FRAMES)]
            direction, shown = dice.choice(("forward", "backward")), dice.randrange(FRAMES)
            desk.do(intents.SetDirection(direction), intents.ShowFrame(shown), intents.Solve(whole=dice.random() < 0.5))
            solve = desk.finish().solve
            assert solve is not None and not solve.running
            listed = {frame.index for frame in solve.listed}
            for index, was in enumerate(before):
                now = self._overlap(desk, index)
                self.tally["better"] += now > was + WORSE
                self.tally["worse"] += now < was - WORSE
                self.tally["silent"] += now < was - WORSE and index not in listed
        except CartsError:
            self.tally["refused"] += 1
        finally:
            desk.close()
            desk.session.editor.project.close()

    def _prepare(self, desk: Desk, dice: random.Random) -> None:
        truth = desk.session.sequence.truth
        assert truth is not None
        for frame in range(FRAMES):
            fate = dice.random()
            if fate < 0.45:
                continue
            desk.do(intents.ShowFrame(frame))
            if fate < 0.65:
                # Right by hand.
                for joint, value in enumerate(truth["PSM1"][frame]):
                    desk.do(intents.SetJoint("PSM1", joint, float(value)), intents.Released())
            elif fate < 0.85:
                # Wrong by hand, by up to eight degrees.
                desk.do(intents.Perturb(dice.uniform(0.5, 8.0), dice.randrange(1000)))
            if dice.random() < 0.3:
                desk.do(intents.SetReview(ReviewState.ACCEPTED))
            if dice.random() < 0.4:
                # Some of what was made by hand is solved all the same.
                desk.do(intents.SetKeyframe(dice.random() < 0.5))

    @staticmethod
    def _overlap(desk: Desk, index: int) -> float:
        """Dice of a frame's saved pose with its true mask."""
        frame = desk.session.sequence.frame(index)
        scores = desk.renderer.scores(desk.session.pose(frame, desk.saved).scene, frame, "left", None)
        assert scores.dice is not None
        return scores.dice


@pytest.fixture
def sets(tiny_sequence: Callable[..., Path]) -> KeyframeSets:
    return KeyframeSets(tiny_sequence(frames=FRAMES, width=96, height=72))


def test_no_frame_becomes_worse_without_being_listed(sets: KeyframeSets) -> None:
    for seed in range(2):
        sets.try_one(seed)
    assert sets.tally["silent"] == 0 and sets.tally["better"] > 0, sets.tally


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("first", range(0, 500, 20))
def test_no_frame_becomes_worse_without_being_listed_in_500_sets_of_keyframes(sets: KeyframeSets, first: int) -> None:
    """Blocks of 20 sets, so that a part can be run alone: `-k "sets_of_keyframes and 280"`."""
    for seed in range(first, first + 20):
        sets.try_one(seed)
    print(f"sets {first} to {first + 19}: {sets.tally}", flush=True)
    assert sets.tally["silent"] == 0, sets.tally
