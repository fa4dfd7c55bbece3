"""Masks of a project: import of annotations as layers, and masks as targets of the optimizer."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool

from ..errors import ProjectError
from ..optimization import GivenMasks
from ..recording import Sequence as Recording
from ..rendering import ImageRenderer
from ..wording import counted, listed
from .layers import ImportedMask
from .project import Project
from .state import ProjectState, corrected_state
from .values import ImportedKeypoints, ImportedLabels, Key

if TYPE_CHECKING:
    from ..recording.annotations import Annotations


MaskLayer = Literal["imported", "painted"]
"""Source of masks in a project."""

_LEFT_OUT = {"ignore", "ignored", "void", "__ignore__"}
"""Names of labels for pixels that are neither instrument nor background."""

Masks = dict[str, Bool[np.ndarray, "height width"]]


def project_masks(layer: MaskLayer, state: ProjectState, recording: Recording) -> GivenMasks:
    """Imported masks, or rendered masks with brush corrections, of a project state; ignore regions are excluded."""
    cameras = [camera.name for camera in recording.scene.cameras]
    if layer == "imported":
        known = state.get(Key.imported_labels())
        names = () if known is None else known.names
        return _labelled("imported mask", cameras, lambda i, c: state.get(Key.imported_mask(i, c)), names, state)
    offset = state.get(Key.time_offset())
    if offset is not None and recording.matching is not None:
        recording = recording.with_time_offset(offset.seconds)
    scene, sequence = recording.scene, recording

    @cache
    def renderer(name: str) -> ImageRenderer:
        own = scene.camera(name)
        return ImageRenderer(scene, width=own.width, height=own.height, cameras=[name])

    def masks(index: int) -> Masks:
        corrections = {name: state.get(Key.mask_correction(index, name)) for name in cameras}
        known = {name: correction for name, correction in corrections.items() if correction is not None}
        if not known:
            return {}
        pose = corrected_state(scene, sequence.frame(index, cameras=[]), state)
        return {name: known[name].applied_to(renderer(name).segment(pose)[0] >= 0) for name in known}

    def there(index: int, camera: str) -> bool:
        return state.get(Key.mask_correction(index, camera)) is not None

    return GivenMasks("painted mask", masks, there, partial(_ignored, state, cameras))


def file_masks(source: Path, recording: Recording) -> GivenMasks:
    """Masks from a file or folder, read by `read_annotations`; `ProjectError` if no mask matches a frame."""
    from ..recording.annotations import read_annotations  # noqa: PLC0415  imports all importers

    found = read_annotations(source, recording)
    layers = {
        (frame.frame, frame.camera): ImportedMask.of(frame.labels) for frame in found.frames if frame.labels is not None
    }
    if not layers:
        there = f" Its images are named {', '.join(map(repr, found.unknown[:3]))}." if found.unknown else ""
        raise ProjectError(
            f"no mask in {source} matches a frame.{there} Frames are named "
            f"{', '.join(map(repr, recording.frame_ids[:3]))}, ...; name the images accordingly."
        )
    cameras = [camera.name for camera in recording.scene.cameras]
    return _labelled(f"mask in {source}", cameras, lambda i, c: layers.get((i, c)), found.label_names)


def ignored_labels(layer: ImportedMask, names: Sequence[str]) -> Bool[np.ndarray, "height width"]:
    """Pixels of a layer whose label is one of the names for ignored pixels, such as `ignore`."""
    numbers = [number for number, name in enumerate(names, start=1) if name.casefold() in _LEFT_OUT]
    return np.isin(layer.labels(), numbers)


def _labelled(
    origin: str,
    cameras: Iterable[str],
    layer: Callable[[int, str], ImportedMask | None],
    names: Sequence[str],
    state: ProjectState | None = None,
) -> GivenMasks:
    """Masks from label images; ignore regions and ignored labels are excluded."""
    cameras = tuple(cameras)

    def layers(index: int) -> dict[str, ImportedMask]:
        return {name: found for name in cameras if (found := layer(index, name)) is not None}

    def masks(index: int) -> Masks:
        return {name: found.mask() & ~ignored_labels(found, names) for name, found in layers(index).items()}

    def ignored(index: int) -> Masks:
        regions = {} if state is None else _ignored(state, cameras, index)
        for name, found in layers(index).items():
            left_out = ignored_labels(found, names)
            if left_out.any():
                regions[name] = left_out | regions.get(name, False)
        return regions

    return GivenMasks(origin, masks, lambda index, name: layer(index, name) is not None, ignored)


def _ignored(state: ProjectState, cameras: Iterable[str], index: int) -> Masks:
    regions = {name: state.get(Key.ignore_region(index, name)) for name in cameras}
    return {name: region.region() for name, region in regions.items() if region is not None}


_SHOWN = 5
"""Maximum number of remarks in a sentence."""


@dataclass(frozen=True)
class ImportReport:
    """Report of an import."""

    kind: str
    """Name of the source's format."""
    masks: int
    """Number of images with masks."""
    keypoints: int
    """Number of images with keypoints."""
    labels: tuple[str, ...]
    """Labels of all imported masks of the project."""
    unknown: tuple[str, ...]
    """Names of images without a matching frame."""
    changed: bool
    """Whether the project changed."""
    remarks: tuple[str, ...] = ()
    """Remarks on the interpretation of masks, and on omitted annotations with reasons."""

    def sentence(self) -> str:
        """Report as a sentence."""
        parts = [counted(self.masks, "mask")] if self.masks else []
        parts += [f"keypoints of {counted(self.keypoints, 'image')}"] if self.keypoints else []
        labels = f" ({listed(self.labels)})" if self.masks and self.labels else ""
        text = f"Imported {' and '.join(parts)} from {self.kind}{labels}."
        if not self.changed:
            text = f"The project already has these {' and '.join(parts)}; nothing was changed."
        if self.unknown:
            skipped = counted(len(self.unknown), "image")
            text += f" Skipped {skipped} without a matching frame, such as {self.unknown[0]}."
        if self.remarks:
            more = f"; and {len(self.remarks) - _SHOWN} more" if len(self.remarks) > _SHOWN else ""
            text += f" Remarks: {'; '.join(self.remarks[:_SHOWN])}{more}."
        return text


def import_annotations(
    project: Project, annotations: "Annotations", *, source: str, replace: bool = False
) -> ImportReport:
    """Import annotations into a project. Painted layers and the recording's own masks are kept.

    Args:
        source: name of the file or folder, for the history.
        replace: whether previously imported layers may be replaced.

    Raises:
        ProjectError: no annotation matches a frame, a layer would be replaced without permission, or the project would
            have too many labels. In these cases nothing is changed.
        SequenceError: the source cannot be read.
    """
    return apply_annotations(project, annotation_edits(project.state, annotations), source=source, replace=replace)


@dataclass(frozen=True, eq=False)
class AnnotationEdits:
    """Annotations as edits of a project."""

    annotations: "Annotations"
    """The annotations, after their iteration."""
    known: ImportedLabels | None
    """Labels of the project, which precede new labels."""
    edits: dict[Key[Any], Any]
    masks: int
    """Number of images with masks."""
    keypoints: int
    """Number of images with keypoints."""


def apply_annotations(project: Project, read: AnnotationEdits, *, source: str, replace: bool = False) -> ImportReport:
    """Second half of `import_annotations`, with the same arguments and errors.

    Raises:
        ProjectError: as `import_annotations`, and if the project has other labels than in `annotation_edits`.
    """
    state, annotations, edits = project.state, read.annotations, read.edits
    unknown = tuple(annotations.unknown)
    if state.get(Key.imported_labels()) != read.known:
        raise ProjectError(f"the imported labels were changed while {source} was read. Import it again.")
    if not edits:
        left = f"{listed(annotations.remarks, 3)}. " if annotations.remarks else ""
        there = left + f"Its images are named {listed([repr(name) for name in unknown[:3]])}. " if unknown else left
        raise ProjectError(
            f"nothing in {source} matches a frame. {there}Frames are named "
            f"{listed(list(state.identity.frame_ids[:3]))}, ...; cameras {listed(state.identity.cameras)}."
        )
    others = [key for key, value in edits.items() if state.get(key) not in (None, value)]
    others = [key for key in others if key != Key.imported_labels()]
    if others and not replace:
        first = state.identity.frame_ids[others[0].frame]
        raise ProjectError(
            f"{counted(len(others), 'earlier import')} would be replaced, the first in frame {first}, camera "
            f"{others[0].name}. Allow this with Replace (--replace), or undo that import."
        )
    change = project.apply(f"Import from {source}"[:200], edits)
    labels = edits[Key.imported_labels()].names
    remarks = tuple(
        text if count == 1 else f"{text} ({counted(count, 'image')})" for text, count in annotations.remarks.items()
    )
    return ImportReport(annotations.kind, read.masks, read.keypoints, labels, unknown, change is not None, remarks)


def annotation_edits(state: ProjectState, annotations: "Annotations") -> AnnotationEdits:
    """First half of `import_annotations`, which reads the source and does not access the project; errors as there."""
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
                    raise ProjectError("the project would have more than 255 labels. Merge some labels.")
                numbers[number] = names.index(name) + 1
            edits[Key.imported_mask(found.frame, found.camera)] = ImportedMask.of(numbers[found.labels])
            masks += 1
        if found.keypoints:
            points = tuple((name, u, v) for name, (u, v) in found.keypoints.items())
            edits[Key.imported_keypoints(found.frame, found.camera)] = ImportedKeypoints(points)
            keypoints += 1
    if edits:
        edits[Key.imported_labels()] = ImportedLabels(tuple(names))
    return AnnotationEdits(annotations, known, edits, masks, keypoints)
