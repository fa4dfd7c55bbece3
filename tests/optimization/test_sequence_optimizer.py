"""Frames corrected together, with eyes that are never wrong but do not see everything."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from perfect_sight import PerfectSight

from carts_core.data import Frame, Sequence
from carts_core.errors import RobotError, SequenceError, SettingsError
from carts_core.optimization import (
    FrameOptimizer,
    FreeParameters,
    OptimizerSettings,
    SequenceOptimizer,
    SequenceSettings,
)
from carts_core.optimization.beginning import best_beginning
from carts_core.optimization.error_model import Gaussian
from carts_core.optimization.parameters import ParameterVector
from carts_core.optimization.sight import Eye, Sight
from carts_core.rendering import Renderer

FRAMES = 6
ALONE = SequenceSettings(opinions=1)
ARM = "PSM1"
WRIST_PITCH = 4


class Sights(PerfectSight):
    """Sees the truth of the frame that was read last."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        truths = [sequence.scene.state(sequence.frame(index).truth or {}) for index in range(len(sequence))]
        self.all = [PerfectSight(sequence, truth).maps for truth in truths]
        self.blind: set[int] = set()
        self.read: list[int] = []

    def load(self, index: int) -> Frame:
        self.read.append(index)
        self.maps = torch.zeros_like(self.all[index]) if index in self.blind else self.all[index]
        return self.sequence.frame(index)


@pytest.fixture
def sights(tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Sights:
    seen = Sights(Sequence.open(tiny_sequence(frames=FRAMES, width=320, height=240)))
    seen.follow_windows(monkeypatch)
    return seen


def optimizer(sights: Sights, **arguments) -> SequenceOptimizer:
    times = {index: float(index) / 10 for index in range(FRAMES)}
    return SequenceOptimizer(sights.sequence.scene, sights.load, times, sights, **arguments)  # pyright: ignore[reportArgumentType]


def error(sights: Sights, index: int, joint_positions: dict[str, np.ndarray]) -> np.ndarray:
    """Absolute error [dofs] [rad, m]."""
    truth = (sights.sequence.frame(index).truth or {})[ARM]
    return np.abs(joint_positions[ARM] - truth)


def wrist_hidden(sights: Sights, hidden: set[int]) -> Callable[[int], dict[str, np.ndarray]]:
    """Occluders of a frame: all that lies beyond the shaft, in the hidden frames."""
    sequence = sights.sequence
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


def test_a_constant_error_is_recovered_in_every_frame(sights: Sights) -> None:
    sequence = optimizer(sights, model=ALONE)
    steps = list(sequence)
    assert [step.index for step in steps[:FRAMES]] == list(range(FRAMES))
    assert [step.start for step in steps[:FRAMES]] == ["cold"] + ["warm"] * (FRAMES - 1)
    assert sequence.stop_reason == "finished" and sequence.progress == (FRAMES, FRAMES)
    assert sequence.frames_per_second > 0
    for index, estimate in sequence.estimates.items():
        found = error(sights, index, estimate.joint_positions)
        before = error(sights, index, sights.sequence.frame(index).measured)
        # Yaw, pitch and insertion move the whole arm in the image.
        assert found[:2].max() < np.deg2rad(0.2) < before[:2].min()
        assert found[2] < 0.0006
        assert found.mean() < 0.7 * before.mean()
        # Deviations are honest: no error is far beyond them.
        assert (found / estimate.joint_std[ARM]).max() < 4
    assert max(step.iterations for step in steps[1:]) < steps[0].iterations


def test_a_joint_that_is_hidden_now_and_then_is_carried_by_the_other_frames(sights: Sights) -> None:
    hidden = {2, 3}
    ignore = wrist_hidden(sights, hidden)
    together = optimizer(sights, ignore=ignore)
    list(together)
    estimates = together.estimates
    for index in hidden:
        alone = FrameOptimizer(sights.sequence.scene, sights.load(index), {}, sights, ignore=ignore(index))  # pyright: ignore[reportArgumentType]
        list(alone)
        assert alone.best is not None
        apart = error(sights, index, alone.best.joint_positions())
        found = error(sights, index, estimates[index].joint_positions)
        assert found[WRIST_PITCH] < 0.6 * apart[WRIST_PITCH]
        # It is known less well than where it is seen, and better than before any image.
        known = estimates[index].uncertainty
        expected = known.expected[known.names.index(f"{ARM}/wrist_pitch")]
        seen = estimates[0].joint_std[ARM][WRIST_PITCH]
        assert 0.99 * seen < estimates[index].joint_std[ARM][WRIST_PITCH] < expected


def test_a_frame_in_which_nothing_is_seen_takes_its_neighbours_correction(sights: Sights) -> None:
    sights.blind = {3}
    # These eyes have no errors that they could share.
    sequence = optimizer(sights, model=SequenceSettings(image_seconds=0.01))
    list(sequence)
    found = error(sights, 3, sequence.estimates[3].joint_positions)
    assert found[:2].max() < np.deg2rad(0.25)
    assert sequence.estimates[3].loss > 3 * sequence.estimates[2].loss


def test_a_keyframe_stays_as_given_and_draws_the_others(sights: Sights) -> None:
    given = {ARM: sights.sequence.frame(2).measured[ARM] + 0.02}
    # Nothing else is seen, so what the others get can only come from the keyframe.
    sights.blind = set(range(FRAMES))
    sequence = optimizer(sights, keyframes={2: given})
    for _ in sequence:
        pass
    estimates = sequence.estimates
    assert np.array_equal(estimates[2].joint_positions[ARM], given[ARM])
    assert np.allclose(estimates[2].state.joint_positions[0].numpy(), given[ARM], atol=1e-6)
    assert estimates[2].start == "keyframe" and not estimates[2].joint_std[ARM].any()
    estimates[2].joint_positions[ARM][:] = 0
    assert np.array_equal(sequence.estimates[2].joint_positions[ARM], estimates[2].joint_positions[ARM])
    for index in (0, 1, 3, 5):
        correction = estimates[index].joint_positions[ARM] - sights.sequence.frame(index).measured[ARM]
        assert 0.012 < correction[0] < 0.0205
        assert (estimates[index].joint_std[ARM] > 0).all()


def test_cancelling_keeps_what_is_there(sights: Sights) -> None:
    sequence = optimizer(sights, model=ALONE)
    sequence.step()
    sequence.step()
    sequence.cancel()
    assert sequence.step() is None and sequence.stop_reason == "cancelled"
    assert list(sequence.estimates) == [0, 1] and sequence.progress == (2, FRAMES)
    assert error(sights, 1, sequence.estimates[1].joint_positions)[:2].max() < np.deg2rad(0.25)


def test_nothing_was_visited_yet(sights: Sights) -> None:
    sequence = optimizer(sights)
    sequence.cancel()
    assert sequence.estimates == {} and sequence.frames_per_second == 0


def test_a_few_frames_are_asked_before_the_first_one(sights: Sights) -> None:
    sequence = optimizer(sights, model=SequenceSettings(opinions=4))
    opinions = [opinion for _ in range(4) if (opinion := sequence.step()) is not None]
    assert [(opinion.index, opinion.start) for opinion in opinions] == [(index, "cold") for index in (0, 2, 3, 5)]
    assert sequence.progress == (0, FRAMES) and sequence.estimates == {} and sequence.frames_per_second == 0
    first = sequence.step()
    assert first is not None and (first.index, first.start) == (0, "cold")
    # What was asked counts as time and steps of the first frame, which begins near its end.
    assert first.seconds > sum(opinion.seconds for opinion in opinions)
    assert 0 < first.iterations - sum(opinion.iterations for opinion in opinions) <= 2
    list(sequence)
    assert sequence.progress == (FRAMES, FRAMES) and sequence.seconds_left == 0


def test_the_first_frame_begins_where_all_that_were_asked_agree(
    sights: Sights, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = np.full(7, 0.011)
    monkeypatch.setattr("carts_core.optimization.sequence.best_beginning", lambda *_: here)
    starts: list[np.ndarray] = []
    warm = Eye.warm

    def watched(eye: Eye, *arguments) -> Sight:
        starts.append(arguments[-1])
        return warm(eye, *arguments)

    sequence = optimizer(sights, model=SequenceSettings(opinions=2))
    assert sequence.step() is not None
    assert sequence.step() is not None
    monkeypatch.setattr(Eye, "warm", watched)
    sequence.step()
    assert np.array_equal(starts[0], here)


def test_cancelling_while_frames_are_asked_leaves_nothing(sights: Sights) -> None:
    sequence = optimizer(sights)
    sequence.step()
    sequence.cancel()
    assert sequence.step() is None and sequence.estimates == {}


def test_a_frame_that_cannot_be_read_is_told_when_its_turn_comes(sights: Sights) -> None:
    def load(index: int) -> Frame:
        if index == FRAMES - 1:
            raise SequenceError("frame 5 is broken")
        return sights.load(index)

    times = {index: float(index) for index in range(FRAMES)}
    sequence = SequenceOptimizer(sights.sequence.scene, load, times, sights)  # pyright: ignore[reportArgumentType]
    with pytest.raises(SequenceError, match="frame 5 is broken"):
        list(sequence)
    assert list(sequence.estimates) == list(range(FRAMES - 1))


@pytest.mark.parametrize("jumped", [False, True])
def test_where_it_begins_suits_all_frames_that_were_asked(sights: Sights, jumped: bool) -> None:
    """What frame 0 sees suits no other frame: nothing tells it from the truth there, or the error has jumped."""
    scene, settings = sights.sequence.scene, OptimizerSettings()
    right, wrong = np.zeros(7), np.deg2rad([-2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    truths = [sights.sequence.frame(index).truth or {} for index in range(FRAMES)]
    if jumped:
        sights.all[0] = PerfectSight(sights.sequence, scene.state({ARM: truths[0][ARM] + wrong})).maps
    else:
        sights.blind = {0}

    def open_frame(index: int) -> tuple[Frame, ParameterVector]:
        return sights.load(index), ParameterVector(scene, scene.state(truths[index]), FreeParameters(), settings.lever)

    eye = Eye(scene, sights, settings, settings.noise, lambda _: {})  # pyright: ignore[reportArgumentType]
    found = best_beginning({0: wrong, 2: right, 4: right}, eye, open_frame, allowance=2.0)
    assert np.array_equal(found, wrong if jumped else right)


def test_frames_in_quick_succession_tell_others_less(sights: Sights) -> None:
    """Errors of images are alike for a while, and the longer that is, the less many frames know."""
    stds = []
    for memory in (0.01, 1.0):
        sequence = optimizer(sights, model=replace(ALONE, image_seconds=memory))
        last = [step for step in sequence if step.index == FRAMES - 1][-1]
        end = sequence.estimates
        stds.append(end[3].joint_std[ARM])
        # The last frame knew all others when it was visited, and for itself it counts whole.
        np.testing.assert_allclose(last.joint_std[ARM], end[FRAMES - 1].joint_std[ARM], rtol=1e-3)
    assert (stds[1] > 1.2 * stds[0]).any() and (stds[1] > 0.99 * stds[0]).all()


def test_a_keyframe_at_the_beginning_asks_nobody(sights: Sights) -> None:
    given = {ARM: (sights.sequence.frame(0).truth or {})[ARM]}
    sequence = optimizer(sights, keyframes={0: given})
    first = sequence.step()
    assert first is not None and first.start == "keyframe" and sequence.progress == (1, FRAMES)


def test_a_keyframe_is_asked_wherever_it_is(sights: Sights) -> None:
    given = {ARM: (sights.sequence.frame(3).truth or {})[ARM]}
    # The others see nothing, so only the person's word can tell where to begin.
    sights.blind = set(range(FRAMES)) - {1, 3}
    sequence = optimizer(sights, model=SequenceSettings(opinions=2), keyframes={3: given})
    opinions = [opinion for _ in range(3) if (opinion := sequence.step()) is not None]
    assert [(opinion.index, opinion.start) for opinion in opinions] == [(0, "cold"), (3, "keyframe"), (5, "cold")]
    assert np.array_equal(opinions[1].joint_positions[ARM], given[ARM])
    list(sequence)
    assert np.array_equal(sequence.estimates[3].joint_positions[ARM], given[ARM])


def test_backward_begins_at_the_last_frame_and_ends_alike(sights: Sights) -> None:
    model = replace(ALONE, direction="backward")
    backward, forward = optimizer(sights, model=model), optimizer(sights, model=ALONE)
    steps = list(backward)
    list(forward)
    assert [step.index for step in steps[:FRAMES]] == list(reversed(range(FRAMES)))
    assert steps[0].start == "cold" and steps[1].start == "warm"
    for index in range(FRAMES):
        there, back = (s.estimates[index].joint_positions[ARM] for s in (forward, backward))
        assert np.abs(there - back)[:2].max() < np.deg2rad(0.1)


def test_a_jump_of_the_error_begins_anew(sights: Sights) -> None:
    """From frame 3 on the encoders are off by other amounts, as after homing."""
    jump = np.deg2rad([2.5, -2.5, 0.0, 0.0, 0.0, 0.0, 0.0])

    def load(index: int) -> Frame:
        frame = sights.load(index)
        return replace(frame, measured={ARM: frame.measured[ARM] + (index >= 3) * jump})

    times = {index: float(index) / 10 for index in range(FRAMES)}
    sequence = SequenceOptimizer(sights.sequence.scene, load, times, sights)  # pyright: ignore[reportArgumentType]
    list(sequence)
    for index, estimate in sequence.estimates.items():
        # Of 3 degrees, the last half degree is held back by what is expected of a constant.
        assert error(sights, index, estimate.joint_positions)[:2].max() < np.deg2rad(0.6)


def test_locked_joints_stay_measured_and_have_no_deviation(sights: Sights) -> None:
    sequence = optimizer(sights, model=ALONE, free=FreeParameters(locked_joints=("roll",)))
    sequence.step()
    (estimate,) = sequence.estimates.values()
    measured = sights.sequence.frame(0).measured[ARM]
    assert estimate.joint_positions[ARM][3] == pytest.approx(measured[3], abs=1e-6)
    assert np.isnan(estimate.joint_std[ARM][3]) and np.isfinite(np.delete(estimate.joint_std[ARM], 3)).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"settings": OptimizerSettings.acs()}, "given the solver adam and the loss acs; it needs gauss_newton"),
        ({"keyframes": {9: {ARM: np.zeros(7)}}}, "keyframe 9 is not among the frames"),
    ],
)
def test_settings_that_do_not_fit_are_refused(sights: Sights, arguments: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        optimizer(sights, **arguments)


def test_a_keyframe_needs_every_arm(sights: Sights) -> None:
    with pytest.raises(RobotError, match="no joint positions for arm 'PSM1'"):
        optimizer(sights, keyframes={0: {}})


@pytest.mark.parametrize(
    ("times", "message"), [({}, "no frames to correct"), ({0: 1.0, 1: 1.0}, "Times must increase")]
)
def test_frames_and_times_that_do_not_fit_are_refused(sights: Sights, times: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        SequenceOptimizer(sights.sequence.scene, sights.load, times, sights)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("name", "value"), [("drift_seconds", 0.0), ("sight_noise", 1e3), ("direction", "sideways")])
def test_settings_out_of_range_are_named(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=f"{name} is {value!r}; allowed is"):
        SequenceSettings(**{name: value})  # pyright: ignore[reportArgumentType]


def test_what_a_frame_tells_others_is_as_firm_as_sight_noise_says(sights: Sights) -> None:
    frame = sights.load(0)
    scene, settings = sights.sequence.scene, OptimizerSettings()
    start = {ARM: (frame.truth or {})[ARM]}

    def look(settings: OptimizerSettings, noise: float) -> Sight:
        parameters = ParameterVector(scene, scene.state(start), FreeParameters(), settings.lever)
        eye = Eye(scene, sights, settings, noise, lambda _: {})  # pyright: ignore[reportArgumentType]
        expected = Gaussian(np.zeros(len(parameters)), np.eye(len(parameters)) * np.deg2rad(1.5) ** 2)
        seen = eye.warm(frame, parameters, expected, np.deg2rad([0.2, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
        return eye.warm(frame, parameters, expected, seen.correction)

    firm, loose = (look(settings, noise) for noise in (settings.noise, 2 * settings.noise))
    np.testing.assert_allclose(firm.correction, loose.correction, atol=1e-6)
    precision = firm.information.precision
    np.testing.assert_allclose(precision, 4.0 * loose.information.precision, rtol=1e-3, atol=1e-3 * precision.max())
    # Edges of so small an image lie elsewhere.
    surface = look(replace(settings, edge_steps=0), settings.noise)
    assert np.abs(surface.correction[:2]).max() < 0.3 * np.deg2rad(0.2), "the truth is at 0"
    assert precision[0, 0] > 1.05 * surface.information.precision[0, 0], "edges tell others, too"
