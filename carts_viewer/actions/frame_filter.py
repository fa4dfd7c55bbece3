"""Filter of frames by review, verdict, Dice, note and corrected arm."""

from dataclasses import dataclass

from carts_core.project import Key, ProjectState, ReviewState, Source, by_hand
from carts_core.project.values import UNREVIEWED

ANY = "Any"
NOT_CHECKED = "not checked"
NO_REVIEW = "unreviewed"
"""Label of frames without a review, regardless of the source of their joint positions."""
BY_HAND = "moved by hand"
SOLVED = "solved together"


@dataclass(frozen=True)
class FrameFilter:
    """Conditions on frames; a frame must meet all of them."""

    review: str = ANY
    """A label from `review_name`, or `NO_REVIEW`."""
    fit: str = ANY
    """A verdict, or `NOT_CHECKED`."""
    dice: float = 1.0
    """Upper bound of the Dice score [1]; 1 disables the condition."""
    note: str = ""
    """Text contained in the note, ignoring case."""
    arm: str = ANY
    """Name of an arm with corrected joints."""

    @property
    def empty(self) -> bool:
        """Whether the filter has no conditions and therefore matches every frame."""
        return self == FrameFilter()


def review_name(project: ProjectState, index: int) -> str:
    """Label of a frame: its review state or, without a review, the source of its joint positions."""
    record = project.records.get(index)
    if by_hand(project, index):
        return BY_HAND
    state = project.review(index).state
    solved = state is ReviewState.OPTIMIZED and record is not None and Source.PROPAGATED in record.sources
    return SOLVED if solved else str(state)


def is_copied(project: ProjectState, index: int) -> bool:
    """Whether the joint positions of a frame were copied from another frame, that is, propagated without a solver."""
    made = [correction.provenance for correction in project.joints(index).values()]
    return any(one.source is Source.PROPAGATED and one.settings is None for one in made)


def matching_frames(project: ProjectState, wanted: FrameFilter) -> list[int]:
    """Indices of the frames that meet all conditions, in order."""
    return [index for index in range(len(project.identity.frame_ids)) if matches(project, index, wanted)]


def matches(project: ProjectState, index: int, wanted: FrameFilter) -> bool:
    """Whether a frame meets all conditions."""
    review = project.review(index)
    names = (ANY, review_name(project, index), *((NO_REVIEW,) if review.state in UNREVIEWED else ()))
    if wanted.review not in names or wanted.note.casefold() not in review.note.casefold():
        return False
    if wanted.fit != ANY:
        verdict = project.verdict(index)
        if wanted.fit != (NOT_CHECKED if verdict is None else verdict.verdict):
            return False
    if wanted.dice < 1.0:
        figures = project.figures(index)
        if figures is None or figures.dice is None or figures.dice >= wanted.dice:
            return False
    return wanted.arm == ANY or project.get(Key.joints(index, wanted.arm)) is not None
