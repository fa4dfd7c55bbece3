"""Curves over all frames for the page's timeline: joints, loss and fit, as lowest and highest of each column."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from carts_core.project import ProjectState
from carts_core.recording import Sequence
from carts_viewer.joint_range import JointRange
from carts_viewer.panels.inputs import humanized
from carts_viewer.panels.joints import to_shown
from carts_viewer.session import Session

_FIGURES = ("Loss [1]", "Dice [1]", "Probability of failure [1]")
_MOST_COLUMNS = 4000


class Traces:
    """Values of every frame, brought up to date as the project changes."""

    def __init__(self, session: Session) -> None:
        frames = len(session.sequence)
        self._sequence: Sequence | None = None
        self._figures = np.full((len(_FIGURES), frames), np.nan, np.float32)
        self._joints = {
            f"{limits.arm} {humanized(limits.joint)} [{'°' if limits.revolute else 'mm'}]": (limits, number)
            for arm in session.scene.arms
            for number, limits in enumerate(limits for limits in session.ranges if limits.arm == arm.name)
        }
        self._corrected: dict[str, Float[np.ndarray, "frames dofs"]] = {
            arm.name: np.full((frames, len(arm.robot.joint_names)), np.nan, np.float32) for arm in session.scene.arms
        }
        self.measure(session.sequence)

    @property
    def names(self) -> list[str]:
        """What can be drawn, with its unit."""
        return [*_FIGURES, *self._joints]

    def measure(self, sequence: Sequence) -> bool:
        """Take the measured joints of this recording; whether they are others than before."""
        other = sequence is not self._sequence
        self._sequence = sequence
        return other

    def follow(self, project: ProjectState, frames: Iterable[int]) -> None:
        """Take what a project says of these frames."""
        for frame in frames:
            figures, verdict = project.figures(frame), project.verdict(frame)
            values = (
                None if figures is None else figures.loss,
                None if figures is None else figures.dice,
                None if verdict is None else verdict.failure,
            )
            self._figures[:, frame] = [np.nan if value is None else value for value in values]
            corrections = project.joints(frame)
            for arm, rows in self._corrected.items():
                known = corrections.get(arm)
                rows[frame] = np.nan if known is None else known.joint_positions

    def between(self, name: str, first: int, last: int, columns: int) -> dict[str, Any] | None:
        """A curve from frame `first` up to, and without, frame `last`; None where there is none.

        Returns:
            `edges`: the frames at which columns begin, and where the last one ends; `curves`: for what was measured (or
            found) and, of joints, what was corrected, the lowest and the highest value of each column, null where there
            is none.
        """
        first, last = max(first, 0), min(last, self._figures.shape[1])
        values = self._values(name)
        if values is None or last <= first or columns < 1:
            return None
        count = min(columns, _MOST_COLUMNS, last - first)
        edges = np.unique(np.linspace(first, last, count + 1).astype(int))
        return {"edges": edges.tolist(), "curves": [_extremes(row[first:last], edges - first) for row in values]}

    def _values(self, name: str) -> list[np.ndarray] | None:
        if name in _FIGURES:
            return [self._figures[_FIGURES.index(name)]]
        if name not in self._joints or self._sequence is None:
            return None
        limits, joint = self._joints[name]
        return [_shown(limits, rows[limits.arm][:, joint]) for rows in (self._sequence.measured, self._corrected)]


def _shown(limits: JointRange, values: np.ndarray) -> np.ndarray:
    return values * to_shown(limits, 1.0)


def _extremes(values: np.ndarray, edges: np.ndarray) -> list[list[float | None]]:
    """Lowest and highest finite value between neighbouring edges."""
    ends = (np.fmin.reduceat(values, edges[:-1]), np.fmax.reduceat(values, edges[:-1]))
    return [[None if np.isnan(value) else float(f"{value:.5g}") for value in end] for end in ends]
