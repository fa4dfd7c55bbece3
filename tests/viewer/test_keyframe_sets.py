"""Solving many frames never makes one worse without saying so, whatever was corrected, accepted or ruined before."""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.project import Project, ReviewState
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory

FRAMES = 5
WORSE = 0.005
"""Less Dice with the true mask by more than this is worse."""


@dataclass
class Tally:
    """What many sets of keyframes have led to."""

    sets: int = 0
    solved: int = 0
    better: int = 0
    worse_taken: int = 0
    """Frames that fit worse than before, listed or not."""
    kept: int = 0
    """Frames that would have been worse, and were kept as they were."""
    silent: int = 0
    """Frames that fit worse than before and are in no list."""
    refused: int = 0
    """Nothing was to be solved."""


class KeyframeSets:
    """Tries random sets of keyframes on one recording, each in a project of its own."""

    def __init__(self, recording: Path) -> None:
        self._sequence = Sequence.open(recording)
        self._factory = OptimizerFactory(report=lambda line: None)
        self.tally = Tally()

    def try_one(self, seed: int) -> None:
        """Correct, ruin and accept some frames, solve between or all, and compare every frame with how it was."""
        dice = random.Random(seed)
        path = self._sequence.path.with_name(f"set_{seed}.carts")
        desk = Desk(self._sequence, Project.open(self._sequence, path), self._factory)
        try:
            desk.do(intents.SetSetting("solver", "surface"))
            self._prepare(desk, dice)
            before = [self._overlap(desk, frame) for frame in range(FRAMES)]
            desk.do(
                intents.SetDirection(dice.choice(("forward", "backward"))),
                intents.ShowFrame(dice.randrange(FRAMES)),
                intents.Solve(whole=dice.random() < 0.5),
            )
            desk.finish()
            self._count(desk, before)
        except CartsError:
            self.tally.refused += 1
        finally:
            desk.close()
            desk.session.editor.project.close()
        self.tally.sets += 1

    def _prepare(self, desk: Desk, dice: random.Random) -> None:
        truth = self._sequence.truth
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
                # What was made by hand is solved all the same where somebody says so.
                desk.do(intents.HoldKeyframe(dice.random() < 0.5))

    def _overlap(self, desk: Desk, index: int) -> float:
        """Dice of a frame's saved pose with its true mask."""
        frame = self._sequence.frame(index)
        scores = desk.renderer.scores(desk.session.pose(frame, desk.saved).scene, frame, "left", None)
        assert scores.dice is not None
        return scores.dice

    def _count(self, desk: Desk, before: list[float]) -> None:
        tally, solve = self.tally, desk.state.solve
        assert solve is not None and not solve.running
        listed = {frame.index: frame for frame in solve.listed}
        for index, was in enumerate(before):
            now = self._overlap(desk, index)
            tally.better += now > was + WORSE
            tally.kept += index in listed and not listed[index].taken
            tally.worse_taken += now < was - WORSE
            tally.silent += now < was - WORSE and index not in listed
        tally.solved += len([frame for frame in range(FRAMES) if desk.saved.joints(frame)])


@pytest.fixture
def sets(tiny_sequence: Callable[..., Path]) -> KeyframeSets:
    return KeyframeSets(tiny_sequence(frames=FRAMES, width=96, height=72))


def test_no_frame_becomes_worse_without_being_listed(sets: KeyframeSets) -> None:
    for seed in range(3):
        sets.try_one(seed)
    assert sets.tally.silent == 0 and sets.tally.better > 0, sets.tally


def test_a_frame_that_became_worse_silently_is_counted(sets: KeyframeSets, monkeypatch: pytest.MonkeyPatch) -> None:
    real, spoilt = KeyframeSets._overlap, {"times": 0}

    def spoiling(self: KeyframeSets, desk: Desk, index: int) -> float:
        spoilt["times"] += 1
        return real(self, desk, index) - 0.1 * (spoilt["times"] > FRAMES)

    monkeypatch.setattr(KeyframeSets, "_overlap", spoiling)
    for seed in range(20):
        if sets.tally.silent:
            break
        spoilt["times"] = 0
        sets.try_one(seed)
    assert sets.tally.silent > 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("first", range(0, 500, 20))
def test_no_frame_becomes_worse_without_being_listed_in_500_sets_of_keyframes(sets: KeyframeSets, first: int) -> None:
    """Blocks of 20 sets, so that a part can be run alone: `-k "sets_of_keyframes and 280"`."""
    began = time.monotonic()
    for seed in range(first, first + 20):
        sets.try_one(seed)
    print(f"sets {first} to {first + 19}, {(time.monotonic() - began) / 20:.1f} s each: {sets.tally}", flush=True)
    assert sets.tally.silent == 0, sets.tally
