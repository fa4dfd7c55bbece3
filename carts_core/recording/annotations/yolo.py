"""Reader of YOLO segmentation labels: a text file of normalized polygons per image, and class names in YAML."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from ...errors import SequenceError
from ...files.reading import CALIBRATION, LABELS, is_regular, parse_yaml, read_text
from ..importing.found import MALFORMED, well_formed
from .images import MAX_IMAGES, ForeignImage, Part, or_left_out
from .shapes import check_shapes, mask_of_polygon

_NAMES = ("data.yaml", "data.yml", "dataset.yaml", "dataset.yml")
_CLASS_LIST = "classes.txt"
_OTHER_TEXTS = (_CLASS_LIST, "train.txt", "val.txt", "valid.txt", "test.txt")
"""Text files of a data set that are not labels of an image."""
_FOLDER = "labels"
_DEEPEST = 4
_BOX = 4
"""Number of values of a bounding box."""
_FARTHEST = 2.0
"""Maximum absolute normalized coordinate; parts outside the image (0 to 1) are omitted."""


def is_yolo_yaml(content: Any) -> bool:
    """Whether parsed YAML is the file of a YOLO data set, with the names of its classes."""
    return isinstance(content, dict) and isinstance(content.get("names"), list | dict)


def yaml_of(folder: Path) -> Path | None:
    """File with the class names in a folder: YAML, or a list; None without one."""
    found = (folder / name for name in (*_NAMES, _CLASS_LIST) if is_regular(folder / name))
    return next(found, None)


def label_files(folder: Path, *, confined: bool = False) -> list[Path]:
    """Label files below a folder, sorted by image; in folders called `labels` if there are any."""
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        if len(Path(place).relative_to(folder).parts) >= _DEEPEST:
            folders.clear()
        found += [Path(place) / name for name in names if name.lower().endswith(".txt") and not name.startswith(".")]
        if len(found) > MAX_IMAGES:
            raise SequenceError(f"{folder} has more than {MAX_IMAGES} label files. Give a folder with fewer.")
    named = [file for file in found if _FOLDER in file.relative_to(folder.parent).parts[:-1]]
    files = [file for file in named or found if file.name not in _OTHER_TEXTS and is_regular(file)]
    files = [file for file in files if not (confined and file.is_symlink())]
    return sorted(files, key=lambda file: (file.stem, file.as_posix()))


def is_label_file(file: Path) -> bool:
    """Whether the first line of a text file is a class and at least four normalized coordinates."""
    try:
        words = next((line.split() for line in read_text(file, LABELS).splitlines() if line.strip()), [])
        return len(words) > _BOX and int(words[0]) >= 0 and all(abs(float(word)) <= _FARTHEST for word in words[1:])
    except MALFORMED:
        return False


def read_yolo(
    folder: Path, files: Iterable[Path], names_file: Path | None, remarks: Counter[str]
) -> Iterator[ForeignImage]:
    """Read label files below a folder; reasons for omitted lines are added to `remarks`."""
    names = {} if names_file is None else _names(names_file)
    for file in files:
        with well_formed(f"{file} cannot be read", "Export it again."):
            lines = [line for line in read_text(file, LABELS).splitlines() if line.strip()]
            check_shapes(len(lines))
        name = file.relative_to(folder.parent).as_posix()
        yield ForeignImage(name, _Lines(name, lines, names, names_file is None, remarks).parts)


class _Lines:
    """Lines of a label file."""

    def __init__(
        self, name: str, lines: Sequence[str], names: dict[int, str], unnamed: bool, remarks: Counter[str]
    ) -> None:
        self._name, self._lines, self._names, self._unnamed, self._remarks = name, lines, names, unnamed, remarks

    def parts(self, height: int, width: int) -> Iterator[Part]:
        """Label and pixels of each line."""
        for number, line in enumerate(self._lines, start=1):
            part, words = None, line.split()
            with or_left_out(f"line {number} of {self._name}", self._remarks):
                part = self._label(int(words[0])), _mask(words[1:], height, width)
            if part is not None:
                yield part

    def _label(self, index: int) -> str:
        if index in self._names:
            return self._names[index]
        if self._unnamed:
            self._remarks["classes have numbers instead of names, since there is no data.yaml"] += 1
            return f"class {index}"
        raise ValueError(f"class {index} has no name in the file of class names")


def _mask(words: Sequence[str], height: int, width: int) -> Bool[np.ndarray, "height width"]:
    if len(words) == _BOX:
        raise ValueError("it is a bounding box, not a polygon")
    if len(words) % 2:
        raise ValueError(f"{len(words)} numbers are not x and y of vertices; export without confidences")
    points = np.array([float(word) for word in words]).reshape(-1, 2)
    if not np.isfinite(points).all() or np.abs(points).max(initial=0) > _FARTHEST:
        raise ValueError("a vertex is not finite, or not normalized by the size of the image (0 to 1)")
    return mask_of_polygon(points * (width, height), height, width)


def _names(path: Path) -> dict[int, str]:
    """Names of the classes by index."""
    with well_formed(f"{path} has no class names", "Expected: `names: {0: NAME, ...}` or `names: [NAME, ...]`."):
        if path.name == _CLASS_LIST:
            return dict(enumerate(line.strip() for line in read_text(path, CALIBRATION).splitlines() if line.strip()))
        content = parse_yaml(read_text(path, CALIBRATION))
        if not is_yolo_yaml(content):
            raise ValueError("it has no `names`")
        if "kpt_shape" in content:
            raise ValueError("it has `kpt_shape`: the labels are boxes with keypoints, not polygons")
        names = content["names"]
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        return {int(index): str(name) for index, name in pairs}
