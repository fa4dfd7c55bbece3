"""Which frame to review next."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterable

from .state import ProjectState
from .values import UNREVIEWED, Figures, ReviewState, Source


def frames_in(state: ProjectState, review_states: Collection[ReviewState]) -> list[int]:
    """Indices of the frames in one of these review states, in order."""
    return [index for index in range(len(state.identity.frame_ids)) if state.review(index).state in review_states]


def by_hand(state: ProjectState, frame: int) -> bool:
    """Whether a person has moved the frame's arms, and nobody has said anything about it yet."""
    record = state.records.get(frame)
    untouched = record is not None and record.review.state is ReviewState.UNTOUCHED
    return record is not None and untouched and Source.HAND in record.sources


def next_unreviewed(state: ProjectState, after: int, step: int = 1, within: range | None = None) -> int | None:
    """The next frame that nobody has judged, coming round at the end; None if there is none.

    Args:
        state: of the project.
        after: index of the present frame, which comes last.
        step: 1 forwards, -1 backwards.
        within: frames to stay in, of which the present one is one; None: all of them.
    """
    frames = within or range(len(state.identity.frame_ids))
    place = after - frames.start
    around = (frames[(place + step * offset) % len(frames)] for offset in range(1, len(frames) + 1))
    return next((index for index in around if state.review(index).state in UNREVIEWED), None)


def between_kept(state: ProjectState, frame: int, within: range | None = None) -> range:
    """From the kept frame before this one to the kept frame after it, both included; see `ProjectState.kept_frames`.

    Where there is none, the sequence's first or last frame takes its place, or that of `within` if the frame is there.
    """
    frames = range(len(state.identity.frame_ids)) if within is None or frame not in within else within
    kept = [index for index in state.kept_frames if index in frames]
    before, after = bisect_left(kept, frame), bisect_right(kept, frame)
    first = kept[before - 1] if before else frames[0]
    last = kept[after] if after < len(kept) else frames[-1]
    return range(first, last + 1)


def worst_first(
    state: ProjectState,
    frames: Iterable[int] | None = None,
    badness: Callable[[Figures], float | None] | None = None,
) -> list[int]:
    """Frames by how badly they fit, worst first; those without figures come last, in order.

    Args:
        state: of the project.
        frames: indices to order, by default all.
        badness: larger is worse, None unknown. By default 1 - Dice if any of the frames has Dice, else the probability
            of a failure if any has a verdict, else the loss.
    """
    indices = list(range(len(state.identity.frame_ids)) if frames is None else frames)
    if badness is None:
        judged = _badness(state, indices)
        return sorted(indices, key=lambda index: -judged.get(index, -math.inf))
    known = {index: figures for index in indices if (figures := state.figures(index)) is not None}
    judged = {index: value for index, figures in known.items() if (value := badness(figures)) is not None}
    return sorted(indices, key=lambda index: -judged.get(index, -math.inf))


def _badness(state: ProjectState, indices: Iterable[int]) -> dict[int, float]:
    """Of the frames of which any is known; all by the same measure, the most telling that there is."""
    dice, failure, loss = {}, {}, {}
    for index in indices:
        figures, verdict = state.figures(index), state.verdict(index)
        if verdict is not None:
            failure[index] = verdict.failure
        if figures is not None and figures.dice is not None:
            dice[index] = 1.0 - figures.dice
        if figures is not None and figures.loss is not None:
            loss[index] = figures.loss
    return dice or failure or loss
