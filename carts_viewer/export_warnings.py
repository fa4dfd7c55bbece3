"""What somebody should know before frames are exported: which of them are doubtful, and fitted to fewer cameras."""

import json
from collections.abc import Collection, Sequence
from functools import lru_cache

from carts_core.project import ProjectState, ReviewState

_NAMED = 6
"""Frames that are named."""


def export_warnings(project: ProjectState, frames: Sequence[int], cameras: Collection[str]) -> list[str]:
    """Warnings for people, none where there is nothing to say.

    Args:
        project: as it is exported.
        frames: indices of those that are exported.
        cameras: whose images and masks are exported.
    """
    found: list[str] = []
    # An hour has 100,000 frames, of which few have a record.
    recorded = [index for index in frames if index in project.records]
    accepted = sum(project.review(index).state is ReviewState.ACCEPTED for index in recorded)
    open_ones = len(frames) - accepted
    if open_ones:
        found.append(f"{open_ones} of {len(frames)} frames {'is' if open_ones == 1 else 'are'} not accepted")
    for verdict, text in (("failed", "failed"), ("doubtful", "are doubtful")):
        those = [i for i in recorded if (known := project.verdict(i)) is not None and known.verdict == verdict]
        found += _line(project, those, f"of these frames {text}")
    partly = [i for i in recorded if not _seen_by_all(project, i, cameras)]
    return found + _line(project, partly, "of these frames were fitted to fewer cameras than are exported")


def _seen_by_all(project: ProjectState, frame: int, cameras: Collection[str]) -> bool:
    """Whether all exported cameras took part in fitting a frame; where nobody knows, they did."""
    used = [_cameras(correction.provenance.settings) for correction in project.joints(frame).values()]
    return all(names is None or set(cameras) <= names for names in used)


@lru_cache(maxsize=256)
def _cameras(settings: str | None) -> frozenset[str] | None:
    """The cameras that an optimizer has used, as its settings say; None where they do not."""
    names = json.loads(settings).get("cameras") if settings else None
    return None if names is None else frozenset(map(str, names))


def _line(project: ProjectState, frames: Sequence[int], text: str) -> list[str]:
    if not frames:
        return []
    named = ", ".join(project.identity.frame_ids[index] for index in frames[:_NAMED])
    more = " …" if len(frames) > _NAMED else ""
    return [f"{len(frames)} {text}: {named}{more}"]
