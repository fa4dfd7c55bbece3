"""People who work on one project at the same time: whose step is whose, and what undo takes back."""

from pathlib import Path

import pytest

from carts_core.errors import CartsError
from carts_core.project import Key, Project, Review, ReviewState
from carts_core.recording import Sequence
from carts_viewer.editing import People

ACCEPTED, REJECTED = Review(ReviewState.ACCEPTED), Review(ReviewState.REJECTED)


@pytest.fixture
def people(tiny_sequence) -> People:
    path: Path = tiny_sequence(frames=4)
    return People(Project.open(Sequence.open(path)))


def _reviews(people: People) -> list[str]:
    return [str(people.project.state.review(frame).state) for frame in range(4)]


def test_somebody_alone_goes_back_and_forth_in_the_history_as_it_is(people: People) -> None:
    ann = people.join()
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    assert people.project.state.steps[0].name == "Accept"
    people.undo(ann)
    assert people.project.state.position == 0 and len(people.project.state.steps) == 1 and people.can_redo(ann)
    people.redo(ann)
    assert people.project.state.position == 1 and not people.can_redo(ann)


def test_undo_takes_back_ones_own_last_step_and_leaves_what_others_did(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(ann, "Accept", {Key.review(1): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(2): REJECTED})
    people.undo(ann)
    people.undo(ann)
    assert _reviews(people) == ["untouched", "untouched", "rejected", "untouched"] and not people.can_undo(ann)
    people.redo(ann)
    people.redo(ann)
    assert _reviews(people) == ["accepted", "accepted", "rejected", "untouched"] and not people.can_redo(ann)
    people.undo(ann)
    people.undo(bob)
    assert _reviews(people) == ["accepted", "untouched", "untouched", "untouched"]
    assert people.project.state.steps[0].name == "Tab 1: Accept"
    assert people.project.state.steps[-1].name == "Tab 2: Undo: Reject"


def test_what_somebody_else_has_changed_since_is_not_taken_back(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(1): ACCEPTED})
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(0): REJECTED})
    with pytest.raises(CartsError, match=r"step 3 \(Tab 2: Reject\) has changed the same since.*Undo again"):
        people.undo(ann)
    assert _reviews(people)[:2] == ["rejected", "accepted"]
    people.undo(ann)
    assert _reviews(people)[:2] == ["rejected", "untouched"]


def test_nobody_goes_back_over_the_steps_of_somebody_at_work(people: People) -> None:
    ann, bob = people.join(), people.join()
    people.apply(ann, "Accept", {Key.review(0): ACCEPTED})
    people.apply(bob, "Reject", {Key.review(2): REJECTED})
    with pytest.raises(CartsError, match="steps of Tab 2"):
        people.go_to(ann, 0)
    bob.present = False
    people.go_to(ann, 0)
    assert people.project.state.position == 0


def test_steps_from_before_the_viewer_started_can_be_taken_back(people: People) -> None:
    people.project.apply("Accept", {Key.review(0): ACCEPTED})
    ann = people.join()
    assert people.can_undo(ann)
    people.undo(ann)
    assert _reviews(people)[0] == "untouched"


def test_beside_others_ones_last_step_from_before_the_viewer_started_is_taken_back_and_theirs_are_not(
    people: People,
) -> None:
    people.project.apply("Ann: Accept", {Key.review(0): ACCEPTED})
    people.project.apply("Accept", {Key.review(1): ACCEPTED})
    people.project.apply("Bob: Reject", {Key.review(2): REJECTED})
    ann, bob = people.join(), people.join()
    ann.chosen, bob.chosen = "Ann", "Bob"
    people.apply(bob, "Reject", {Key.review(3): REJECTED})
    for expected in (["accepted", "untouched"], ["untouched", "untouched"]):
        assert people.can_undo(ann)
        people.undo(ann)
        assert _reviews(people) == [*expected, "rejected", "rejected"]
    assert not people.can_undo(ann) and people.undo(ann) is None
    people.redo(ann)
    people.undo(bob)
    people.undo(bob)
    assert _reviews(people) == ["accepted", "untouched", "untouched", "untouched"] and not people.can_undo(bob)
