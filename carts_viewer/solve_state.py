"""How solving many frames together goes, and what came of it."""

from dataclasses import dataclass


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

    @property
    def progress(self) -> tuple[int, int]:
        """Steps that are done, and all of them: every frame is visited, and then compared."""
        return self.done + self.compared, 2 * len(self.frames)
