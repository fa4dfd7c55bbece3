"""How solving many frames together goes, and what came of it."""

from dataclasses import dataclass
from typing import Any

from carts_core.project import ProjectState
from carts_core.project.values import WHOLE_PROJECT


@dataclass(frozen=True)
class ListedFrame:
    """A frame that somebody should look at after many were solved together."""

    index: int
    reason: str
    """For people."""
    taken: bool
    """Whether what was solved is in the project; otherwise the frame is as it was, until somebody takes it."""


@dataclass(frozen=True)
class SolveState:
    """Solving many frames together, or how it ended."""

    frames: range
    """From the first to the last one, kept frames included."""
    done: int = 0
    """Frames that were visited."""
    compared: int = 0
    """Frames that were compared with how they were, which comes after that."""
    running: bool = True
    text: str = ""
    """How it goes, for people."""
    listed: tuple[ListedFrame, ...] = ()
    """Frames whose fit became worse, or is doubtful."""
    base_frame_gain: float | None = None
    """At the end, what free base frames would explain of what is left [1]; None where it is not known."""
    calibration: Any = None
    """The project's calibration that this is about."""

    def suspicion(self, project: ProjectState) -> float | None:
        """`base_frame_gain`, as long as nothing runs and the project's calibration is the same."""
        same = project.records.get(WHOLE_PROJECT) is self.calibration
        return self.base_frame_gain if same and not self.running else None

    @property
    def progress(self) -> tuple[int, int]:
        """Steps that are done, and all of them: every frame is visited, and then compared."""
        return self.done + self.compared, 2 * len(self.frames)
