"""Masks and keypoints of others as layers of a project, in one step of undo."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ProjectError
from ..wording import counted, listed
from .keys import Key
from .layers import ImportedMask
from .project import Project
from .state import ProjectState
from .values import ImportedKeypoints, ImportedLabels

if TYPE_CHECKING:
    from ..recording.annotations import Annotations

_SHOWN = 5
"""Remarks in a sentence."""


@dataclass(frozen=True)
class ImportReport:
    """What was imported."""

    kind: str
    """The source's format, for people."""
    masks: int
    """Images that got a mask."""
    keypoints: int
    """Images that got keypoints."""
    labels: tuple[str, ...]
    """That the masks have."""
    unknown: tuple[str, ...]
    """Images of the source that belong to no frame."""
    changed: bool
    """Whether the project changed; False where it had all of it already."""
    remarks: tuple[str, ...] = ()
    """What was decided about masks, and annotations that were left out, each with its reason."""

    def sentence(self) -> str:
        """For people."""
        parts = [counted(self.masks, "mask")] if self.masks else []
        parts += [f"keypoints of {counted(self.keypoints, 'image')}"] if self.keypoints else []
        labels = f" ({listed(self.labels)})" if self.masks and self.labels else ""
        text = f"Imported {' and '.join(parts)} from {self.kind}{labels}."
        if not self.changed:
            text = f"The project has these {' and '.join(parts)} already; nothing was changed."
        if self.unknown:
            text += f" {counted(len(self.unknown), 'image')} of no frame left out, say {self.unknown[0]}."
        if self.remarks:
            more = f"; and {len(self.remarks) - _SHOWN} more" if len(self.remarks) > _SHOWN else ""
            text += f" Remarks: {'; '.join(self.remarks[:_SHOWN])}{more}."
        return text


def import_annotations(
    project: Project, annotations: "Annotations", *, source: str, replace: bool = False
) -> ImportReport:
    """Put annotations into a project. What a person has painted stays as it is; so does the recording's own truth.

    Args:
        project: open for writing.
        annotations: of the same sequence.
        source: name of the file or folder, for the history.
        replace: whether layers that were imported before may be replaced by others.

    Raises:
        ProjectError: nothing belongs to a frame, or a layer would be replaced that may not be. Nothing is changed then.
        SequenceError: the source cannot be read.
    """
    state = project.state
    edits, masks, keypoints = _edits(state, annotations)
    unknown = tuple(annotations.unknown)
    if not edits:
        left = f"{listed(annotations.remarks, 3)}. " if annotations.remarks else ""
        there = left + f"Its images are called {listed([repr(name) for name in unknown[:3]])}. " if unknown else left
        raise ProjectError(
            f"nothing in {source} belongs to a frame. {there}Frames are called "
            f"{listed(list(state.identity.frame_ids[:3]))}, ...; cameras {listed(state.identity.cameras)}."
        )
    others = [key for key, value in edits.items() if state.get(key) not in (None, value)]
    others = [key for key in others if key != Key.imported_labels()]
    if others and not replace:
        first = state.identity.frame_ids[others[0].frame]
        raise ProjectError(
            f"{counted(len(others), 'layer')} imported before would be replaced, the first in frame {first}, camera "
            f"{others[0].name}. Say so (Replace, or --replace), or undo that import."
        )
    change = project.apply(f"Import from {source}"[:200], edits)
    labels = edits[Key.imported_labels()].names
    remarks = tuple(
        text if count == 1 else f"{text} ({counted(count, 'image')})" for text, count in annotations.remarks.items()
    )
    return ImportReport(annotations.kind, masks, keypoints, labels, unknown, change is not None, remarks)


def _edits(state: ProjectState, annotations: "Annotations") -> tuple[dict[Key[Any], Any], int, int]:
    """What changes, and how many images have masks and keypoints; numbers of labels go on from those that are there."""
    known = state.get(Key.imported_labels())
    names = [] if known is None else list(known.names)
    edits: dict[Key[Any], Any] = {}
    masks = keypoints = 0
    for found in annotations.frames:
        if found.labels is not None:
            names += [name for name in annotations.label_names if name not in names]
            numbers = np.zeros(256, np.uint8)
            for number, name in enumerate(annotations.label_names, start=1):
                if names.index(name) > 254:
                    raise ProjectError("the project has more than 255 labels then. Join some of them.")
                numbers[number] = names.index(name) + 1
            edits[Key.imported_mask(found.frame, found.camera)] = ImportedMask.of(numbers[found.labels])
            masks += 1
        if found.keypoints:
            points = tuple((name, u, v) for name, (u, v) in found.keypoints.items())
            edits[Key.imported_keypoints(found.frame, found.camera)] = ImportedKeypoints(points)
            keypoints += 1
    if edits:
        edits[Key.imported_labels()] = ImportedLabels(tuple(names))
    return edits, masks, keypoints
