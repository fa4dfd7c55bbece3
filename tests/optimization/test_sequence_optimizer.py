"""Frames corrected together, with a predictor that is never wrong but does not see everything."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from perfect_predictor import PerfectPredictor
from short_sequence import ALONE, ARM, FRAMES, Truths, optimizer

from carts_core.errors import RobotError, SequenceError, SettingsError
from carts_core.networks import FeatureExtractor
from carts_core.optimization import (
    DescentSolver,
    FrameOptimizer,
    FreeParameters,
    NetworkPredictor,
    SequenceOptimizer,
    SequenceSettings,
    SurfaceSolver,
    Verdict,
)
from carts_core.optimization.sequence import Keyframes, initial_correction
from carts_core.optimization.sequence_frame import FrameEstimate, Origin, SequenceFrameSolver
from carts_core.optimization.variables import Variables
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer

WRIST_PITCH = 4


def error(truths: Truths, index: int, joint_positions: dict[str, np.ndarray]) -> np.ndarray:
    """Absolute error [dofs] [rad, m]."""
    truth = (truths.sequence.frame(index).truth or {})[ARM]
    return np.abs(joint_positions[ARM] - truth)


def wrist_hidden(truths: Truths, hidden: set[int]) -> Callable[[int], dict[str, np.ndarray]]:
    """Occluders of a frame: all that lies beyond the shaft, in the hidden frames."""
    sequence = truths.sequence
    renderer = Renderer(sequence.scene, cameras=["left"])

    def ignore(index: int) -> dict[str, np.ndarray]:
        if index not in hidden:
            return {}
        frame = sequence.frame(index)
        there = renderer.segment(sequence.scene.state(frame.truth or {}))[0] >= 0
        # The wrist is what moves when the wrist is bent.
        bent = {ARM: frame.measured[ARM] + np.eye(7)[4] * 0.5}
        moved = renderer.segment(sequence.scene.state(bent))[0] >= 0
        changed = (there ^ moved).astype(np.uint8)
        assert changed.any()
        return {"left": cv2.dilate(changed, np.ones((41, 41), np.uint8)) > 0}

    return ignore


@pytest.fixture(scope="module")
def forward(made_truths: Truths) -> tuple[SequenceOptimizer, list[FrameEstimate]]:
    """A finished optimization of the frames in their order, and its steps."""
    sequence = optimizer(made_truths.fresh(), model=ALONE)
    return sequence, list(sequence)


def test_constant_errors_are_recovered(truths: Truths, forward: tuple[SequenceOptimizer, list[FrameEstimate]]) -> None:
    sequence, steps = forward
    assert [step.index for step in steps[:FRAMES]] == list(range(FRAMES))
    assert [step.start for step in steps[:FRAMES]] == ["cold"] + ["warm"] * (FRAMES - 1)
    assert sequence.stop_reason == "finished" and sequence.progress == (FRAMES, FRAMES)
    assert sequence.frames_per_second > 0
    for index, estimate in sequence.estimates.items():
        found = error(truths, index, estimate.joint_positions)
        before = error(truths, index, truths.sequence.frame(index).measured)
        # Yaw, pitch and insertion move the whole arm in the image.
        assert found[:2].max() < np.deg2rad(0.2) < before[:2].min()
        assert found[2] < 0.0006
        assert found.mean() < 0.7 * before.mean()
        # Deviations are honest: no error is far beyond them.
        assert (found / estimate.joint_std[ARM]).max() < 4
    assert max(step.iterations for step in steps[1:] if step.assessment is None) < steps[0].iterations


@pytest.mark.slow
def test_a_joint_that_is_hidden_now_and_then_is_carried_by_the_other_frames(truths: Truths) -> None:
    hidden = {2, 3}
    ignore = wrist_hidden(truths, hidden)
    together = optimizer(truths, ignore=ignore)
    list(together)
    estimates = together.estimates
    for index in hidden:
        alone = FrameOptimizer(truths.sequence.scene, truths.load(index), {}, truths, ignore=ignore(index))
        list(alone)
        assert alone.best is not None
        apart = error(truths, index, alone.best.joint_positions())
        found = error(truths, index, estimates[index].joint_positions)
        assert found[WRIST_PITCH] < 0.6 * apart[WRIST_PITCH]
        # It is known less well than where it is seen, and better than before any image.
        known = estimates[index].uncertainty
        expected = known.expected[known.names.index(f"{ARM}/wrist_pitch")]
        seen = estimates[0].joint_std[ARM][WRIST_PITCH]
        assert 0.99 * seen < estimates[index].joint_std[ARM][WRIST_PITCH] < expected


@pytest.fixture(scope="module")
def drawn(made_truths: Truths) -> Callable[..., SequenceOptimizer]:
    """Solves the sequence from a keyframe at frame 2, 0.02 off; no other frame shows anything."""
    truths = made_truths.fresh()
    truths.blind = set(range(FRAMES))

    @cache
    def solve(*std: float) -> SequenceOptimizer:
        given = {ARM: truths.sequence.frame(2).measured[ARM] + 0.02}
        known = {2: {ARM: np.array(std)}} if std else None
        sequence = optimizer(truths, keyframes={2: given}, keyframe_std=known)
        list(sequence)
        return sequence

    return solve


def correction(sequence: SequenceOptimizer, truths: Truths, index: int) -> np.ndarray:
    return sequence.estimates[index].joint_positions[ARM] - truths.sequence.frame(index).measured[ARM]


def test_keyframes_stay_and_inform_their_neighbours(truths: Truths, drawn: Callable[..., SequenceOptimizer]) -> None:
    sequence, estimates = drawn(), drawn().estimates
    given = truths.sequence.frame(2).measured[ARM] + 0.02
    assert np.array_equal(estimates[2].joint_positions[ARM], given)
    assert np.allclose(estimates[2].state.joint_positions[0].numpy(), given, atol=1e-6)
    assert estimates[2].start == "keyframe" and not estimates[2].joint_std[ARM].any()
    for index in (0, 1, 3, 5):
        assert 0.012 < correction(sequence, truths, index)[0] < 0.0205
        assert (estimates[index].joint_std[ARM] > 0).all()


@pytest.mark.slow
def test_uncertain_keyframes_inform_others_less(truths: Truths, drawn: Callable[..., SequenceOptimizer]) -> None:
    std, roll = (1e-3, 1e-3, np.nan, 0.01, 1e-3, 1e-3, 1e-3), 3
    exact, uncertain = drawn(), drawn(*std)
    assert np.array_equal(uncertain.estimates[2].joint_std[ARM], np.nan_to_num(std))
    assert np.array_equal(correction(uncertain, truths, 2), correction(exact, truths, 2)), "it stays as given"
    one, other = (sequence.estimates[1].joint_std[ARM] for sequence in (exact, uncertain))
    assert other[roll] > 1.5 * one[roll]
    # It comes from an image, whose errors are those of its neighbours.
    share = np.tanh(0.05 / SequenceSettings().shared_seconds)
    assert np.hypot(3e-3, one[0]) < other[0] < np.hypot(1e-3 / np.sqrt(share), one[0])
    moved = [correction(sequence, truths, 1)[roll] for sequence in (exact, uncertain)]
    assert 0.0 < moved[1] < 0.8 * moved[0], "less of the guess is carried over"


def test_keyframes_without_a_deviation_are_exact(truths: Truths) -> None:
    given = {index: truths.sequence.frame(index).measured for index in range(4)}
    std = {1: {ARM: np.zeros(7)}, 2: {ARM: np.full(7, np.nan)}, 3: {ARM: np.array([np.nan] * 6 + [1e-3])}}
    assert Keyframes(truths.sequence.scene, given, std).exact == {0, 1, 2}


def test_a_keyframe_that_the_other_frames_contradict_is_not_visited_again(truths: Truths) -> None:
    given = {2: {ARM: truths.sequence.frame(2).measured[ARM] + 0.1}}
    sequence = optimizer(truths, model=ALONE, keyframes=given, keyframe_std={2: {ARM: np.full(7, 5e-3)}})
    list(sequence)
    assert sequence.estimates[2].start == "keyframe"
    assert np.array_equal(sequence.estimates[2].joint_positions[ARM], given[2][ARM])


def test_cancelling_keeps_what_is_there(truths: Truths) -> None:
    sequence = optimizer(truths, model=ALONE)
    sequence.step()
    sequence.step()
    sequence.cancel()
    assert sequence.step() is None and sequence.stop_reason == "cancelled"
    assert list(sequence.estimates) == [0, 1] and sequence.progress == (2, FRAMES)
    assert error(truths, 1, sequence.estimates[1].joint_positions)[:2].max() < np.deg2rad(0.25)


def test_a_frame_that_cannot_be_read_is_told_when_its_turn_comes(truths: Truths) -> None:
    def load(index: int) -> Frame:
        if index == FRAMES - 1:
            raise SequenceError("frame 5 is broken")
        return truths.load(index)

    times = {index: float(index) for index in range(FRAMES)}
    sequence = SequenceOptimizer(truths.sequence.scene, load, times, truths)
    with pytest.raises(SequenceError, match="frame 5 is broken"):
        list(sequence)
    assert list(sequence.estimates) == list(range(FRAMES - 1))


@pytest.mark.parametrize("jumped", [False, True])
def test_where_it_starts_suits_all_frames_that_were_solved_alone(truths: Truths, jumped: bool) -> None:
    """The prediction for frame 0 fits no other frame: it is wrong only there, or the error has jumped."""
    scene, settings = truths.sequence.scene, SurfaceSolver()
    right, wrong = np.zeros(7), np.deg2rad([-2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    states = [truths.sequence.frame(index).truth or {} for index in range(FRAMES)]
    if jumped:
        truths.all[0] = PerfectPredictor(truths.sequence, scene.state({ARM: states[0][ARM] + wrong})).maps
    else:
        truths.blind = {0}

    def open_frame(index: int) -> tuple[Frame, Variables]:
        state = scene.state(states[index])
        return truths.load(index), Variables(scene, state, FreeParameters(), settings.length_scale)

    solver = SequenceFrameSolver(scene, truths, settings, SequenceSettings(), lambda _: {})
    found = initial_correction({0: wrong, 2: right, 4: right}, solver, open_frame, allowance=2.0)
    assert np.array_equal(found, wrong if jumped else right)


def test_backward_ends_as_forward(truths: Truths, forward: tuple[SequenceOptimizer, list[FrameEstimate]]) -> None:
    backward = optimizer(truths, model=replace(ALONE, direction="backward"))
    steps = list(backward)
    assert [step.index for step in steps[:FRAMES]] == list(reversed(range(FRAMES)))
    assert steps[0].start == "cold" and steps[1].start == "warm"
    for index in range(FRAMES):
        there, back = (s.estimates[index].joint_positions[ARM] for s in (forward[0], backward))
        assert np.abs(there - back)[:2].max() < np.deg2rad(0.1)


@pytest.mark.slow
def test_frames_without_an_image_are_carried_and_not_assessed(truths: Truths) -> None:
    blank = {0, 2, 3}

    def load(index: int) -> Frame:
        frame = truths.load(index)
        black = {name: np.zeros_like(image) for name, image in frame.images.items()}
        return replace(frame, images=black, missing=("left",)) if index in blank else frame

    times = {index: float(index) / 10 for index in range(FRAMES)}
    for model in (ALONE, SequenceSettings(between=())):
        sequence = SequenceOptimizer(truths.sequence.scene, load, times, truths, model=model)
        list(sequence)
        assert sequence.assessment is not None and sequence.assessment.verdict is Verdict.GOOD
        assert sequence.assessment.counts["good"] == FRAMES - len(blank)
        for index, estimate in sequence.estimates.items():
            assert (estimate.start == "carried") == (estimate.assessment is None) == (index in blank)
            assert error(truths, index, estimate.joint_positions)[:2].max() < np.deg2rad(0.3)
    nothing = SequenceOptimizer(truths.sequence.scene, load, {2: None, 3: None}, truths)
    list(nothing)
    assert nothing.assessment is None and nothing.base_frame_gain() is None and len(nothing.estimates) == 2


def test_a_recording_that_begins_before_the_arm_is_in_view(truths: Truths) -> None:
    """Something else is detected in the first frames."""
    absent, outside = {0, 1}, np.array([1.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    scene = truths.sequence.scene

    def load(index: int) -> Frame:
        frame = truths.load(index)
        if index in absent:
            truths.maps = torch.zeros_like(truths.maps)
            truths.maps[:, 1, 100:300, 100:300] = 1.0
            frame = replace(frame, measured={ARM: frame.measured[ARM] + outside})
        return frame

    assert (Renderer(scene).segment(scene.state(load(0).measured)) < 0).all()
    times = {index: float(index) / 10 for index in range(FRAMES)}
    model = SequenceSettings(initial_frames=2, between=())
    sequence = SequenceOptimizer(scene, load, times, truths, model=model)
    list(sequence)
    estimates = sequence.estimates
    assert estimates[2].start == "cold" and estimates[3].start == "warm"
    for index in set(range(FRAMES)) - absent:
        assert error(truths, index, estimates[index].joint_positions)[:2].max() < np.deg2rad(0.3)
    for index in absent:
        found = estimates[index].assessment
        assert found is not None and found.nothing_there
    assert sequence.assessment is not None and sequence.assessment.counts["good"] == FRAMES - len(absent)


def test_a_jump_of_the_error_begins_anew(truths: Truths) -> None:
    """From frame 3 on the encoders are off by other amounts, as after homing."""
    jump = np.deg2rad([2.5, -2.5, 0.0, 0.0, 0.0, 0.0, 0.0])

    def load(index: int) -> Frame:
        frame = truths.load(index)
        return replace(frame, measured={ARM: frame.measured[ARM] + (index >= 3) * jump})

    times = {index: float(index) / 10 for index in range(FRAMES)}
    sequence = SequenceOptimizer(truths.sequence.scene, load, times, truths)
    list(sequence)
    for index, estimate in sequence.estimates.items():
        # Of 3 degrees, the last half degree is held back by what is expected of a constant.
        assert error(truths, index, estimate.joint_positions)[:2].max() < np.deg2rad(0.6)


@pytest.mark.slow
def test_a_jump_of_one_of_two_arms_is_found_with_the_shipped_network(sample_sequence_path: Path) -> None:
    sequence = Sequence.open(sample_sequence_path)
    scene, rng = sequence.scene.with_cameras(["left"]), np.random.default_rng(5)
    first, *others = (arm.name for arm in scene.arms)
    wrong = {name: np.deg2rad(rng.choice([-1.5, 1.5], 7)) * [1, 1, 0.05, 1, 1, 1, 1] for name in (first, *others)}
    jump = {first: np.deg2rad([2.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0])}

    def load(index: int) -> Frame:
        frame = sequence.frame(index, "regular", ["left"])
        truth = frame.truth or {}
        measured = {name: truth[name] + wrong[name] + (index >= 12) * jump.get(name, 0.0) for name in truth}
        return replace(frame, measured=measured)

    times = {index: index / 25 for index in range(24)}
    optimizer = SequenceOptimizer(scene, load, times, NetworkPredictor(FeatureExtractor.load()))
    list(optimizer)
    for index, estimate in optimizer.estimates.items():
        truth = load(index).truth or {}
        assert np.abs(estimate.joint_positions[first] - truth[first])[:2].mean() < np.deg2rad(0.4)


def test_locked_joints_stay_measured_and_have_no_deviation(truths: Truths) -> None:
    sequence = optimizer(truths, model=ALONE, free=FreeParameters(locked_joints=("roll",)))
    sequence.step()
    (estimate,) = sequence.estimates.values()
    measured = truths.sequence.frame(0).measured[ARM]
    assert estimate.joint_positions[ARM][3] == pytest.approx(measured[3], abs=1e-6)
    assert np.isnan(estimate.joint_std[ARM][3]) and np.isfinite(np.delete(estimate.joint_std[ARM], 3)).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"settings": DescentSolver()}, "requires the solver `surface`; given: a solver for the loss 'acs'"),
        ({"keyframes": {9: {ARM: np.zeros(7)}}}, "keyframe 9 is not among the frames"),
    ],
)
def test_settings_that_do_not_fit_are_refused(truths: Truths, arguments: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        optimizer(truths, **arguments)


def test_a_keyframe_needs_every_arm(truths: Truths) -> None:
    with pytest.raises(RobotError, match="joint positions of arm 'PSM1' are missing"):
        optimizer(truths, keyframes={0: {}})


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ({}, "no frame was given"),
        ({0: 1.0, 1: 1.0}, "Times must increase"),
        ({0: 5.0, 1: None}, "1 of 2 frames have no time; the first is frame 1. Give times for all frames or for none"),
    ],
)
def test_frames_and_times_that_do_not_fit_are_refused(truths: Truths, times: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SequenceOptimizer(truths.sequence.scene, truths.load, times, truths)


@pytest.mark.parametrize(
    ("name", "value"), [("drift_seconds", 0.0), ("measurement_noise", 1e3), ("direction", "sideways")]
)
def test_settings_out_of_range_are_named(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=f"{name} is {value!r}; allowed:"):
        SequenceSettings(**{name: value})  # pyright: ignore[reportArgumentType]


def test_frames_in_quick_succession_inform_others_less(truths: Truths) -> None:
    """Errors of images are alike for a while, and the longer that is, the less many frames know."""
    stds = []
    for memory in (0.01, 1.0):
        sequence = optimizer(truths, model=replace(ALONE, correlation_seconds=memory, shared_seconds=memory))
        last = [step for step in sequence if step.index == FRAMES - 1][-1]
        end = sequence.estimates
        stds.append(end[3].joint_std[ARM])
        # The last frame knew all others when it was visited, and for itself it counts whole.
        np.testing.assert_allclose(last.joint_std[ARM], end[FRAMES - 1].joint_std[ARM], rtol=1e-3)
    assert (stds[1] > 1.2 * stds[0]).any() and (stds[1] > 0.99 * stds[0]).all()


def test_deviations_count_on_no_more_than_images_that_differ(truths: Truths) -> None:
    """An error of the network common to all frames is not averaged out, and does not change the estimates."""
    ends = []
    for shared in (0.5, 5.0):
        sequence = optimizer(truths, model=replace(ALONE, correlation_seconds=0.5, shared_seconds=shared))
        list(sequence)
        ends.append(sequence.estimates)
    for index in range(FRAMES):
        narrow, wide = (end[index] for end in ends)
        assert np.array_equal(narrow.joint_positions[ARM], wide.joint_positions[ARM])
        assert (wide.joint_std[ARM] > 0.999 * narrow.joint_std[ARM]).all()
    assert (ends[1][3].joint_std[ARM] > 1.1 * ends[0][3].joint_std[ARM]).any()


def test_doubtful_frames_are_less_certain(
    truths: Truths, forward: tuple[SequenceOptimizer, list[FrameEstimate]]
) -> None:
    """Unless its values come from elsewhere."""
    (sequence, _), scene = forward, truths.sequence.scene
    for start in Origin:
        estimate = replace(sequence.estimates[2], start=start)
        assert estimate.assessment is not None
        doubtful = replace(estimate.assessment, verdict=Verdict.DOUBTFUL, probability=0.4)
        judged = estimate.judged(doubtful, scene)
        assert judged.assessment is doubtful
        elsewhere = start in (Origin.KEYFRAME, Origin.CARRIED)
        known, before = judged.joint_std[ARM], estimate.joint_std[ARM]
        assert np.array_equal(known, before) if elsewhere else (known > 1.1 * before).any(), start
        np.testing.assert_array_equal(known, judged.uncertainty.joint_std(ARM, scene.arms[0].robot.joint_names))
