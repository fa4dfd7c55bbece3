"""Frames by what was said and found about them."""

from dataclasses import dataclass

from carts_core.project import Key, ProjectState, by_hand

ANY = "Any"
NOT_CHECKED = "not checked"
BY_HAND = "moved by hand"


@dataclass(frozen=True)
class FrameFilter:
    """What frames are looked for; all conditions hold."""

    review: str = ANY
    """A review state, or `BY_HAND`."""
    fit: str = ANY
    """A verdict, or `NOT_CHECKED`."""
    dice: float = 1.0
    """Overlap with the truth below this; at 1 the truth does not matter [1]."""
    note: str = ""
    """Part of the note, in any case."""
    arm: str = ANY
    """An arm that was corrected."""

    @property
    def empty(self) -> bool:
        """Whether every frame is found."""
        return self == FrameFilter()


def found(project: ProjectState, wanted: FrameFilter) -> list[int]:
    """Indices of the frames that are looked for, in order."""
    return [index for index in range(len(project.identity.frame_ids)) if matches(project, index, wanted)]


def matches(project: ProjectState, index: int, wanted: FrameFilter) -> bool:
    """Whether a frame is one of those that are looked for."""
    review = project.review(index)
    name = BY_HAND if by_hand(project, index) else str(review.state)
    if wanted.review not in (ANY, name) or wanted.note.casefold() not in review.note.casefold():
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
