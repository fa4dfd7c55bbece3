"""Two people in two tabs, on different frames, at random: nothing of one gets into the other's work."""

import random
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from viewer_tab import OpenViewer, place_of

from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.tabs import Tab
from tools.raw_tab import RawTab

FRAMES = 8
REVIEWS = (ReviewState.ACCEPTED, ReviewState.REJECTED, ReviewState.NEEDS_WORK)


@dataclass
class Model:
    """What one person has done to their own frames, as it should be."""

    place: Tab
    frames: range
    dice: random.Random
    index: int
    values: dict[tuple[int, str], Any] = field(default_factory=dict)
    done: list[tuple[int, dict[str, tuple[object, object]]]] = field(default_factory=list)
    """Frame, and what of it was how before and after."""
    undone: list[tuple[int, dict[str, tuple[object, object]]]] = field(default_factory=list)

    def act(self) -> None:
        """Do something at random, in the viewer and here."""
        kind = self.dice.choice(("joint", "joint", "review", "note", "undo", "undo", "redo", "go"))
        if kind == "go":
            self.index = self.dice.choice(self.frames)
            self.place.put(intents.ShowFrame(self.index))
        elif kind == "undo":
            self.place.put(intents.Undo())
            self._move(self.done, self.undone, before=True)
        elif kind == "redo":
            self.place.put(intents.Redo())
            self._move(self.undone, self.done, before=False)
        else:
            self._edit(kind)

    def _edit(self, kind: str) -> None:
        value: object
        if kind == "joint":
            value = self.dice.uniform(-0.2, 0.2)
            self.place.put(intents.SetJoint("PSM1", 0, value))
        elif kind == "note":
            value = f"note {self.dice.random()}"
            self.place.put(intents.SetNote(value))
        else:
            known = self.values.get((self.index, kind))
            value = self.dice.choice([review for review in REVIEWS if review is not known])
            self.place.put(intents.SetReview(value))
        self.place.put(intents.Released())
        step: dict[str, tuple[object, object]] = {kind: (self.values.get((self.index, kind)), value)}
        if kind == "joint" and self.values.get((self.index, "review")) is ReviewState.ACCEPTED:
            step["review"] = (ReviewState.ACCEPTED, None)
        self.values.update({(self.index, name): after for name, (_, after) in step.items()})
        self.done.append((self.index, step))
        self.undone.clear()

    def _move(self, source: list, target: list, *, before: bool) -> None:
        if not source:
            return
        step = source.pop()
        target.append(step)
        self.index = step[0]
        self.values.update({(self.index, name): pair[0 if before else 1] for name, pair in step[1].items()})

    def check(self, app: ViewerApp, measured: np.ndarray) -> None:
        """Fail unless this person's tab and frames are as they should be."""
        state = self.place.controller.state
        assert state.error is None, state.error
        assert state.index == self.index, f"the frame has jumped to {state.index} from {self.index}"
        for frame in self.frames:
            joint, review = self.values.get((frame, "joint")), app.project.state.review(frame)
            found = app.project.state.joints(frame)
            expected = measured[frame] if joint is None else joint
            assert abs((found["PSM1"].joint_positions[0] if found else measured[frame]) - expected) < 1e-6
            assert review.state is (self.values.get((frame, "review")) or ReviewState.UNTOUCHED)
            assert review.note == (self.values.get((frame, "note")) or "")


def _campaign(app: ViewerApp, actions: int, seed: int) -> None:
    measured = app.sequence.measured["PSM1"][:, 0]
    dice = random.Random(seed)
    with RawTab(app.url, keep=1) as first, RawTab(app.url, keep=1) as second:
        half = FRAMES // 2
        models = [
            Model(place_of(app, first), range(half), dice, 0),
            Model(place_of(app, second), range(half, FRAMES), dice, half),
        ]
        models[1].place.put(intents.ShowFrame(half))
        app.wait_until_shown()
        for _ in range(actions):
            # Both act before either has been heard, in any order.
            for model in dice.sample(models, 2):
                model.act()
            app.wait_until_shown()
            for model in models:
                model.check(app, measured)
        edits = sum(len(model.done) for model in models)
        assert edits > 0 and any(step.name.startswith("Tab 2: ") for step in app.project.state.steps)


def test_two_people_on_different_frames_do_not_disturb_one_another(open_viewer: OpenViewer) -> None:
    _campaign(open_viewer(frames=FRAMES, masks=False), 40, 1)


@pytest.mark.slow
def test_two_people_do_two_thousand_things_each(open_viewer: OpenViewer) -> None:
    _campaign(open_viewer(frames=FRAMES, masks=False), 2000, 2)
