"""Recognition of annotation formats by content."""

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ...errors import SequenceError
from ...files.reading import VALUES, is_regular, parse_yaml, read_text
from ...settings import ANNOTATION_FORMATS, AnnotationFormat
from ...wording import listed
from ..images import read_labels
from ..importing.found import read_json, well_formed
from .formats import MEANINGS, mask_files, read_coco, read_cvat, read_mask_folder, read_surgpose
from .images import MAX_IMAGES, ForeignImage
from .label_studio import is_label_studio, is_minimal, read_label_studio
from .labelme import is_labelme, is_xanylabeling, read_labelme
from .yolo import is_label_file, is_yolo_yaml, label_files, read_yolo, yaml_of

_OF_FOLDERS: tuple[AnnotationFormat, ...] = ("labelme", "yolo", "masks")
_SAMPLED = 5
"""Maximum number of files of a folder that are read to recognize its format."""
_DEEPEST = 4
_IMAGES = "images"
"""Folder of the annotated images in a YOLO data set."""
_MOST_LABELS = 32
"""Maximum number of values of an image that may be a mask."""
_SUPPORTED = (
    "Give a file of COCO, LabelMe, X-AnyLabeling or Label Studio (.json), CVAT (.xml) or SurgPose (.yaml), a folder of "
    "LabelMe files, YOLO labels with data.yaml, or PNG masks."
)

_Read = tuple[str, Iterator[ForeignImage]]


def recognized(place: Path, format: AnnotationFormat | None, remarks: Counter[str], *, confined: bool = False) -> _Read:
    """Name of the format of a file or folder, and its images.

    Args:
        format: format of the source; by default recognized by content.
        remarks: decisions and omitted annotations, added during the iteration.
        confined: whether links, and files next to the source, are ignored.

    Raises:
        SequenceError: the format is not supported, or a folder has annotations of several formats.
    """
    if format is not None and format not in ANNOTATION_FORMATS:
        raise SequenceError(f"{format!r} is not a format of annotations. Choose one of: {listed(ANNOTATION_FORMATS)}.")
    if place.is_dir():
        return _read_folder(place, format, remarks, confined)
    suffix = place.suffix.lower()
    if suffix == ".json":
        return _read_json(place, format, remarks)
    if suffix == ".xml":
        _check(place, format, "cvat")
        return ANNOTATION_FORMATS["cvat"], read_cvat(place, remarks)
    if suffix in (".yaml", ".yml"):
        with well_formed(f"{place} cannot be read", "Correct it."):
            content = parse_yaml(read_text(place, VALUES))
        if is_yolo_yaml(content):
            _check(place, format, "yolo")
            return ANNOTATION_FORMATS["yolo"], read_yolo(place.parent, _labels(place.parent, confined), place, remarks)
        _check(place, format, "surgpose")
        return ANNOTATION_FORMATS["surgpose"], read_surgpose(place, content, remarks)
    raise SequenceError(f"{place} has no masks or keypoints in a supported format. {_SUPPORTED}")


def _check(place: Path, wanted: AnnotationFormat | None, found: AnnotationFormat) -> None:
    if wanted not in (None, found):
        raise SequenceError(f"{place} has the format {found}, not {wanted}. Omit the format, so that it is recognized.")


def _read_json(place: Path, format: AnnotationFormat | None, remarks: Counter[str]) -> _Read:
    content = read_json(place)
    if is_labelme(content):
        _check(place, format, "labelme")
        return _labelme_name(content), read_labelme([(place, "")], remarks)
    if is_label_studio(content):
        _check(place, format, "label-studio")
        return ANNOTATION_FORMATS["label-studio"], read_label_studio(place, content, remarks)
    if is_minimal(content):
        raise SequenceError(f"{place} is an export of Label Studio as JSON-MIN. Export it as JSON.")
    if isinstance(content, dict) and {"images", "annotations"} <= content.keys():
        _check(place, format, "coco")
        return ANNOTATION_FORMATS["coco"], read_coco(place, content, remarks)
    raise SequenceError(
        f"{place} is not a file of COCO (`images`, `annotations`), LabelMe or X-AnyLabeling (`shapes`, `imagePath`), "
        "or Label Studio (a list of tasks with `data` and `annotations`). Export it in one of these formats."
    )


def _labelme_name(content: Any) -> str:
    return "X-AnyLabeling" if is_xanylabeling(content) else ANNOTATION_FORMATS["labelme"]


def _read_folder(place: Path, format: AnnotationFormat | None, remarks: Counter[str], confined: bool) -> _Read:
    if format not in (None, *_OF_FOLDERS):
        raise SequenceError(f"{place} is a folder, but an export in the format {format} is a file. Give the file.")
    json_files = _json_files(place, confined) if format in (None, "labelme") else []
    samples = [content for file in json_files[:_SAMPLED] if is_labelme(content := _json_or_none(file))]
    text_files = label_files(place, confined=confined) if format in (None, "yolo") else []
    names_file = yaml_of(place)
    yolo = bool(text_files) and (names_file is not None or all(map(is_label_file, text_files[:_SAMPLED])))
    found: list[AnnotationFormat] = []
    found += ("labelme",) if samples else ()
    found += ("yolo",) if yolo else ()
    if format is None and len(found) == 1:
        annotated = {(file.parent, file.stem) for file in (*json_files, *text_files)}
        others = (file for file in mask_files(place, confined=confined) if (file.parent, file.stem) not in annotated)
        others = [file for file in others if not (yolo and _IMAGES in file.relative_to(place).parts)]
        found += ("masks",) if any(map(_may_be_mask, others[:_SAMPLED])) else ()
    if format is None and len(found) > 1:
        raise SequenceError(
            f"{place} has annotations of several formats ({listed(found)}). Choose one with Source format "
            "(--format), or give the folder of one."
        )
    chosen = format or next(iter(found), "masks")
    if chosen == "labelme":
        if not samples:
            raise SequenceError(f"{place} has no files of LabelMe (.json with `shapes` and `imagePath`).")
        folders = [(file, file.parent.relative_to(place.parent).as_posix()) for file in json_files]
        return _labelme_name(samples[0]), read_labelme(folders, remarks)
    if chosen == "yolo":
        return ANNOTATION_FORMATS["yolo"], read_yolo(
            place, _labels(place, confined), _names_above(place, confined), remarks
        )
    return ANNOTATION_FORMATS["masks"], read_mask_folder(place, remarks, confined=confined)


def _labels(folder: Path, confined: bool) -> list[Path]:
    files = label_files(folder, confined=confined)
    if not files:
        raise SequenceError(f"{folder} has no YOLO labels (.txt). Give the folder that contains them.")
    return files


def _names_above(folder: Path, confined: bool) -> Path | None:
    """File with the class names of YOLO labels, in their folder or, unless confined, in the two above."""
    folders = [folder] if confined else [folder, *list(folder.absolute().parents)[:2]]
    return next((file for file in map(yaml_of, folders) if file is not None), None)


def _json_files(folder: Path, confined: bool) -> list[Path]:
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        if len(Path(place).relative_to(folder).parts) >= _DEEPEST:
            folders.clear()
        chosen = (name for name in names if name.lower().endswith(".json") and name not in MEANINGS)
        found += [Path(place) / name for name in chosen if not name.startswith(".")]
        if len(found) > MAX_IMAGES:
            raise SequenceError(f"{folder} has more than {MAX_IMAGES} JSON files. Give a folder with fewer.")
    files = [file for file in found if is_regular(file) and not (confined and file.is_symlink())]
    return sorted(files, key=lambda file: (file.stem, file.as_posix()))


def _json_or_none(file: Path) -> Any:
    try:
        return read_json(file)
    except SequenceError:
        return None


def _may_be_mask(file: Path) -> bool:
    """Whether an image has few values, as masks and label images have."""
    try:
        image = read_labels(file)
    except SequenceError:
        return False
    if image.mask is not None:
        return bool(image.mask.any())
    return not image.lossy and len(set(map(tuple, image.colours.reshape(-1, 3)[::7].tolist()))) <= _MOST_LABELS
