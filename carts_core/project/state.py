"""Everything a project says at one moment, as an immutable snapshot."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from .identity import SequenceIdentity
from .keys import Edits, Key, Kind
from .values import Figures, JointCorrection, Review, Source

V = TypeVar("V")


@dataclass(frozen=True)
class Step:
    """One gesture, which is one step of undo."""

    number: int
    """From 1, without gaps."""
    name: str
    time: float
    """When it was made [s since 1970]."""


@dataclass(frozen=True)
class ExportRecord:
    """One finished export."""

    time: float
    """When it was finished [s since 1970]."""
    format: str
    path: str
    frames: int
    """How many frames it holds."""
    settings: str
    """JSON text."""


@dataclass(frozen=True)
class Entry:
    """A value and the step that made it. The value is None where that step removed it."""

    step: int
    value: Any


@dataclass(frozen=True, eq=False)
class ProjectState:
    """Everything a project says at one moment. Nothing changes it; an edit makes a new one."""

    identity: SequenceIdentity
    steps: tuple[Step, ...]
    """The history, oldest first; those after `position` are undone and can be redone."""
    position: int
    """How many steps are done."""
    entries: Mapping[Key[Any], Entry]
    """What differs from the sequence, or once did."""
    all_figures: Mapping[tuple[int, int], Figures]
    """(frame, revision) -> figures; see `revision`."""
    exports: tuple[ExportRecord, ...]

    def get(self, key: Key[V]) -> V | None:
        """The value under a key; None where it is as the sequence says."""
        entry = self.entries.get(key)
        return None if entry is None else entry.value

    def values(self, kind: Kind) -> dict[Key[Any], Any]:
        """All values of one kind."""
        return {key: e.value for key, e in self.entries.items() if key.kind is kind and e.value is not None}

    def joints(self, frame: int) -> dict[str, JointCorrection]:
        """Corrected joint positions of a frame, for the arms that have some."""
        found = {arm: self.get(Key.joints(frame, arm)) for arm in self.identity.arms}
        return {arm: correction for arm, correction in found.items() if correction is not None}

    def review(self, frame: int) -> Review:
        """Review state and note of a frame; untouched at first."""
        return self.get(Key.review(frame)) or Review()

    def is_keyframe(self, frame: int) -> bool:
        """Whether propagation must keep the frame: a person said so, or made its joint positions and said nothing."""
        said = self.get(Key.keyframe(frame))
        if said is not None:
            return said.held
        return any(correction.provenance.source is Source.HAND for correction in self.joints(frame).values())

    def figures(self, frame: int) -> Figures | None:
        """Figures of a frame as it now is; None if they were not computed since it changed."""
        return self.all_figures.get((frame, self.revision(frame)))

    def revision(self, frame: int) -> int:
        """The last step that changed what figures of this frame depend on; 0 if none did."""
        identity = self.identity
        keys = [
            *(Key.joints(frame, arm) for arm in identity.arms),
            *(Key.base_frame(arm) for arm in identity.arms),
            *(make(frame, name) for name in identity.cameras for make in (Key.mask_correction, Key.ignore_region)),
            *(make(name) for name in identity.cameras for make in (Key.extrinsics, Key.intrinsics)),
        ]
        return max((self.entries[key].step for key in keys if key in self.entries), default=0)

    @property
    def undoable(self) -> Step | None:
        """The step that `Project.undo` takes back."""
        return self.steps[self.position - 1] if self.position else None

    @property
    def redoable(self) -> Step | None:
        """The step that `Project.redo` does again."""
        return self.steps[self.position] if self.position < len(self.steps) else None

    def after(self, step: Step, edits: Edits) -> "ProjectState":
        """The state after one more step; what could be redone is gone."""
        return replace(
            self,
            steps=(*self.steps[: self.position], step),
            position=step.number,
            entries={**self.entries, **{key: Entry(step.number, value) for key, value in edits.items()}},
            all_figures={key: value for key, value in self.all_figures.items() if key[1] <= self.position},
        )

    def moved(self, position: int, entries: Mapping[Key[Any], Entry | None]) -> "ProjectState":
        """The state at another position of the history, where these entries differ (None: not there)."""
        kept = {key: entry for key, entry in self.entries.items() if key not in entries}
        found = {key: entry for key, entry in entries.items() if entry is not None}
        return replace(self, position=position, entries={**kept, **found})

    def with_figures(self, figures: Iterable[tuple[tuple[int, int], Figures]]) -> "ProjectState":
        """The state with these figures added."""
        return replace(self, all_figures={**self.all_figures, **dict(figures)})
