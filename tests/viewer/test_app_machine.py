"""Random actions on the app's controller and on a model in plain Python, whose states must be equal."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from many_actions import check_after_each_of_10000_actions
from viewer_desk import Desk

from carts_core.errors import CartsError
from carts_core.project import Project, ReviewState, Source
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.jobs.optimizers import OptimizerFactory

FRAMES = 3
ARM = "PSM1"
_STEP = 5e-4
"""Between two values that joints are dragged to [rad]: none comes twice."""


@dataclass(frozen=True)
class FrameModel:
    """What a frame should be; joint positions of None are the measured ones."""

    joints: tuple[float, ...] | None = None
    copied: bool = False
    review: ReviewState = ReviewState.UNTOUCHED
    note: str = ""
    marked: bool | None = None

    @property
    def keyframe(self) -> bool:
        """Said so, or made by hand."""
        by_hand = self.joints is not None and not self.copied
        return by_hand if self.marked is None else self.marked


@dataclass
class AppModel:
    """Frames after every step, and a gesture that is not finished."""

    snapshots: list[tuple[FrameModel, ...]] = field(default_factory=lambda: [(FrameModel(),) * FRAMES])
    position: int = 0
    index: int = 0
    drag: tuple[FrameModel, ...] | None = None

    @property
    def frames(self) -> tuple[FrameModel, ...]:
        """As they are shown."""
        return self.snapshots[self.position] if self.drag is None else self.drag

    def release(self) -> None:
        """The gesture under way is a step."""
        frames, self.drag = self.frames, None
        if frames != self.snapshots[self.position]:
            self.snapshots[self.position + 1 :] = [frames]
            self.position += 1

    def changed(self, **changes) -> tuple[FrameModel, ...]:
        """The frames, with another shown one; it is not accepted any more if its joints are others."""
        frames = list(self.frames)
        before = frames[self.index]
        after = replace(before, **changes)
        if after.joints != before.joints and before.review is ReviewState.ACCEPTED:
            after = replace(after, review=ReviewState.UNTOUCHED)
        frames[self.index] = after
        return tuple(frames)

    def do(self, **changes) -> None:
        """A whole gesture in the shown frame."""
        self.release()
        self.drag = self.changed(**changes)
        self.release()

    def go_to(self, position: int) -> None:
        """Undo or redo; a frame of one of the steps between is shown."""
        self.release()
        before, self.position = self.position, min(max(position, 0), len(self.snapshots) - 1)
        steps = range(min(before, self.position), max(before, self.position))
        pairs = [(self.snapshots[step], self.snapshots[step + 1]) for step in steps]
        changed = [index for index in range(FRAMES) if any(old[index] != new[index] for old, new in pairs)]
        if changed and self.index not in changed:
            self.index = changed[0]


def _machine(path: Path, factory: OptimizerFactory) -> type[RuleBasedStateMachine]:
    sequence = Sequence.open(path)
    low, high = sequence.scene.arm(ARM).robot.joint_limits.T
    measured = [sequence.frame(index, cameras=[]).measured[ARM] for index in range(FRAMES)]

    class AppMachine(RuleBasedStateMachine):
        """What people do in the page, in any order."""

        @initialize()
        def begin(self) -> None:
            self.model, self.values = AppModel(), 0
            for file in path.parent.glob("machine.carts*"):
                file.unlink()
            self.desk = Desk(sequence, Project.open(sequence, path.with_name("machine.carts")), factory)

        def teardown(self) -> None:
            if hasattr(self, "desk"):
                self.desk.session.close()
                self.desk.session.editor.project.close()

        def _joints(self) -> np.ndarray:
            joints = self.model.frames[self.model.index].joints
            return np.array(measured[self.model.index] if joints is None else joints)

        @rule(joint=st.integers(0, 1), count=st.integers(1, 3), release=st.booleans())
        def drag(self, joint: int, count: int, release: bool) -> None:
            self.model.release()
            self.desk.do(intents.Released())
            for _ in range(count):
                self.values += 1
                self.desk.do(intents.SetJoint(ARM, joint, _STEP * self.values))
            moved = self._joints()
            moved[joint] = _STEP * self.values
            self.model.drag = self.model.changed(joints=tuple(moved), copied=False)
            if release:
                self.desk.do(intents.Released())
                self.model.release()

        @rule(degrees=st.sampled_from((0.1, 1.0)))
        def nudge(self, degrees: float) -> None:
            self.desk.do(intents.ChooseJoint((ARM, 1)), intents.Nudge(degrees))
            moved = self._joints()
            moved[1] = min(moved[1] + np.deg2rad(degrees), high[1])
            self.model.release()
            if abs(moved[1] - self._joints()[1]) > 1e-5:  # Else it is at its limit.
                self.model.do(joints=tuple(moved), copied=False)

        @rule()
        def back_to_measured(self) -> None:
            self.desk.do(intents.BackToMeasured(ARM))
            self.model.do(joints=None, copied=False)

        @rule(step=st.sampled_from((-1, 1)))
        def copy(self, step: int) -> None:
            source = self.model.index + step
            if not 0 <= source < FRAMES or self.model.frames[source].joints is None:
                with pytest.raises(CartsError):
                    self.desk.do(intents.CopyCorrection(step))
                return
            change = np.array(self.model.frames[source].joints) - measured[source]
            copied = np.clip(measured[self.model.index] + change, low, high)
            if np.abs(copied - self._joints()).max() > 1e-5:  # Else it is a matter of rounding whether that is a step.
                self.desk.do(intents.CopyCorrection(step))
                self.model.do(joints=tuple(copied), copied=True)

        @rule(state=st.sampled_from([state for state in ReviewState if state is not ReviewState.OPTIMIZED]))
        def review(self, state: ReviewState) -> None:
            self.desk.do(intents.SetReview(state))
            self.model.do(review=state)

        @rule(text=st.text(max_size=20), release=st.booleans())
        def note(self, text: str, release: bool) -> None:
            self.model.release()
            self.desk.do(intents.Released(), intents.SetNote(text))
            self.model.drag = self.model.changed(note=self.desk.state.review.note)
            if release:
                self.desk.do(intents.Released())
                self.model.release()

        @rule(on=st.booleans())
        def keyframe(self, on: bool) -> None:
            self.desk.do(intents.SetKeyframe(on))
            self.model.do(marked=on)

        @rule(index=st.integers(0, FRAMES - 1))
        def show(self, index: int) -> None:
            self.desk.do(intents.Released(), intents.ShowFrame(index))
            self.model.release()
            self.model.index = index

        @rule()
        def undo(self) -> None:
            self.model.release()
            self.desk.do(intents.Undo())
            self.model.go_to(self.model.position - 1)

        @rule()
        def redo(self) -> None:
            self.model.release()
            self.desk.do(intents.Redo())
            self.model.go_to(self.model.position + 1)

        @rule(share=st.floats(0, 1))
        def go_to(self, share: float) -> None:
            self.model.release()
            position = round(share * (len(self.model.snapshots) - 1))
            self.desk.do(intents.GoToStep(position))
            self.model.go_to(position)

        @rule()
        def reopen(self) -> None:
            self.model.release()
            self.desk.close()
            self.desk = self.desk.reopened()
            self.model.index = 0

        @invariant()
        def they_say_the_same(self) -> None:
            if not hasattr(self, "desk"):
                return
            state, model = self.desk.state, self.model
            assert state.index == model.index and state.frame.index == model.index
            steps = len(model.snapshots) - 1
            assert (self.desk.saved.position, len(self.desk.saved.steps)) == (model.position, steps)
            assert state.unsaved == (model.drag is not None)
            for index, expected in enumerate(model.frames):
                review, joints = state.project.review(index), state.project.joints(index)
                assert (review.state, review.note) == (expected.review, expected.note)
                assert state.project.is_keyframe(index) == expected.keyframe
                assert (expected.joints is None) == (not joints)
                if expected.joints is not None:
                    np.testing.assert_allclose(joints[ARM].joint_positions, expected.joints, atol=1e-6)
                    source = Source.PROPAGATED if expected.copied else Source.HAND
                    assert joints[ARM].provenance.source is source
            shown = self.desk.session.joints(state.pose.scene)[ARM]
            np.testing.assert_allclose(shown, self._joints(), atol=1e-6)

    return AppMachine


@pytest.fixture
def machine(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> type[RuleBasedStateMachine]:
    factory = OptimizerFactory(weights=(untrained_weights,), report=lambda line: None)
    return _machine(tiny_sequence(frames=FRAMES), factory)


def test_the_app_says_what_the_model_says_after_every_action(machine: type[RuleBasedStateMachine]) -> None:
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=10,
            stateful_step_count=30,
            deadline=None,
            derandomize=True,
            suppress_health_check=[HealthCheck.too_slow],
        ),
    )


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_app_says_what_the_model_says_after_each_of_10000_actions(machine: type[RuleBasedStateMachine]) -> None:
    check_after_each_of_10000_actions(machine)
