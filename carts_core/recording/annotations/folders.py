"""Folders of mask images: white on black, labels as grey values, or labels as colours (EndoVis 2017 and 2018)."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from ...errors import SequenceError
from ...files.reading import VALUES, is_regular, parse_json, read_text
from ..images import read_labels
from .found import MOST_IMAGES, ForeignImage

_SUFFIXES = (".png", ".bmp")
_OTHER_SUFFIXES = (".tif", ".tiff", ".jpg", ".jpeg")
"""Looked for where there are none of these, since masks lie beside images."""
_DEEPEST = 4
_MEANINGS = ("labels.json", "mappings.json", "mapping.json", "instrument_type_mapping.json")
_TOOL = "_labels"
_INSTRUMENT = "instrument"
_MOST_UNNAMED = 32
"""Values of one image; more come from interpolation."""
_BACKGROUND = ("background", "background-tissue")
_SCENE_PARTS = ("instrument", "clasper", "wrist", "shaft")
"""How EndoVis 2018 begins the names of what belongs to an instrument; everything else is anatomy or thread."""

_Colours = Mapping[tuple[int, int, int], str]


def is_mask_folder(path: Path) -> bool:
    """Whether it is a folder."""
    return path.is_dir()


def read_mask_folder(path: Path, remarks: Counter[str], *, confined: bool = False) -> Iterator[ForeignImage]:
    """The images below a folder; files of one name in folders beside one another belong to one frame.

    Args:
        path: of the folder.
        remarks: what was changed or decided about how many files is added while they are decoded.
        confined: whether links are left out, and what values mean is not looked for above the folder.

    Raises:
        SequenceError: there are none, or it is not known what their values mean.
    """
    there = [file for file in _files(_finest(path)) if not (confined and file.is_symlink())]
    files = [file for file in there if file.suffix.lower() in _SUFFIXES] or there
    if not files:
        known = ", ".join((*_SUFFIXES, *_OTHER_SUFFIXES))
        raise SequenceError(f"{path} has no masks ({known}). Name the folder that holds them.")
    meanings: dict[Path, Any] = {}
    for file in files:
        above = _meaning_file(file, path if confined else path.parent, confined)
        if above is not None and above not in meanings:
            meanings[above] = _meaning(above)
        meaning = None if above is None else meanings[above]
        yield ForeignImage(
            file.relative_to(path.parent).as_posix(), lambda file=file, meaning=meaning: _parts(file, meaning, remarks)
        )


def _finest(path: Path) -> Path:
    """Of an export of carts, the folder with links."""
    return path / "links" if (path / "labels.json").is_file() and (path / "links").is_dir() else path


def _files(folder: Path) -> list[Path]:
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        if len(Path(place).relative_to(folder).parts) >= _DEEPEST:
            folders.clear()
        chosen = [name for name in names if name.lower().endswith((*_SUFFIXES, *_OTHER_SUFFIXES))]
        found += [Path(place) / name for name in chosen if not name.startswith(".")]
        if len(found) > MOST_IMAGES:
            raise SequenceError(f"{folder} has more than {MOST_IMAGES} masks. Name a folder with fewer.")
    # Files of one frame follow each other: tools have folders of their own beside one another.
    files = [file for file in found if is_regular(file)]
    return sorted(files, key=lambda file: (file.stem, file.parent.parent.as_posix(), file.as_posix()))


def _meaning_file(file: Path, top: Path, confined: bool) -> Path | None:
    """What says what the values mean: in the mask's folder or one above, up to the top."""
    for folder in file.parents:
        for name in _MEANINGS:
            if is_regular(folder / name) and not (confined and (folder / name).is_symlink()):
                return folder / name
        if folder == top:
            break
    return None


def _meaning(path: Path) -> Any:
    try:
        return parse_json(read_text(path, VALUES))
    except (OSError, ValueError) as error:
        raise SequenceError(f"{path} cannot be read ({error}). Correct it or remove it.") from error


def _parts(file: Path, meaning: Any, remarks: Counter[str]) -> Iterator[tuple[str, Bool[np.ndarray, "height width"]]]:
    image = read_labels(file)
    tool = next((part.removesuffix(_TOOL) for part in file.parts[::-1] if part.endswith(_TOOL)), "")
    yield "", np.zeros(image.colours.shape[:2], bool)
    try:
        if isinstance(meaning, list):
            yield from _by_colour(image.colours, _colours(meaning), file)
            return
        names = _names(meaning, file.parent.name)
        remarks.update(image.remarks)
        if image.mask is not None and not names:
            if image.mask.any():
                yield tool or _INSTRUMENT, image.mask
        elif image.values is None:
            raise SequenceError(
                f"{file} has colours, and no labels.json in its folder or above says what they mean. Add one as "
                'EndoVis 2018 has it: [{"name": ..., "color": [r, g, b]}, ...].'
            )
        else:
            yield from _by_value(image.values, names, tool, file)
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise SequenceError(f"what the values of {file} mean cannot be read ({error}).") from error


def _colours(meaning: list[Any]) -> _Colours:
    rows = [(tuple(int(value) for value in entry["color"]), str(entry["name"])) for entry in meaning]
    return {colour: name for colour, name in rows if len(colour) == 3}  # type: ignore[misc]


def _by_colour(
    image: np.ndarray, colours: _Colours, file: Path
) -> Iterator[tuple[str, Bool[np.ndarray, "height width"]]]:
    code = image.astype(np.int64) @ (65536, 256, 1)
    there = {int(value) for value in np.unique(code)}
    known = {colour[0] * 65536 + colour[1] * 256 + colour[2]: name for colour, name in colours.items()}
    if unknown := there - known.keys():
        raise SequenceError(f"{file} has the colour #{min(unknown):06x}, which labels.json does not know. Add it.")
    for value in sorted(there):
        if known[value].lower().startswith(_SCENE_PARTS):
            yield known[value], code == value


def _by_value(
    image: np.ndarray, names: Mapping[int, str], tool: str, file: Path
) -> Iterator[tuple[str, Bool[np.ndarray, "height width"]]]:
    values = [int(value) for value in np.unique(image) if value]
    unknown = [value for value in values if value not in names]
    if len(unknown) > _MOST_UNNAMED:
        raise SequenceError(
            f"{file} has {len(unknown)} values without a name, {values[0]} to {values[-1]}. Labels that were resized "
            "with interpolation have such: resize them by the nearest neighbour, or name each value in labels.json."
        )
    for value in values:
        name = names.get(value, f"label {value}")
        if name.lower() not in _BACKGROUND:
            yield f"{tool}.{name}" if tool else name, image == value


def _names(meaning: Any, folder: str) -> dict[int, str]:
    """Grey value -> name, of a file that says either of both first."""
    if not isinstance(meaning, dict):
        return {}
    if isinstance(inner := meaning.get(folder), dict):
        meaning = inner
    names: dict[int, str] = {}
    for key, value in meaning.items():
        if str(key).isdecimal() and isinstance(value, str):
            names[int(key)] = value
        elif isinstance(value, int):
            names[value] = str(key)
    return {value: name for value, name in names.items() if value}
