"""Names of files per frame: `left/{frame}.jpg`, `{domain}/{index:06d}.png`, `left/*.jpg`."""

import re
from collections.abc import Sequence
from pathlib import Path

from ..errors import SequenceError
from .toml_table import closest

_PLACEHOLDERS = ("frame", "index", "domain", "camera")
_EXAMPLE = '"left/{frame}.jpg", "left/{frame:06d}.png", "{domain}/{index:04d}.jpg"'


class FrameId(str):
    """A frame's id that a pattern can pad: `{frame}` is the text, `{frame:03d}` its number."""

    def __format__(self, spec: str) -> str:
        return format(int(self), spec) if spec.endswith("d") else format(str(self), spec)


def expand(pattern: str, key: str, **values: object) -> str:
    """`pattern` with its {placeholders} filled in.

    Args:
        pattern: as written in the sequence file.
        key: how errors call it.
        values: what may be filled in.

    Raises:
        SequenceError: an unknown placeholder, or a number format for an id that is no number.
    """
    try:
        return pattern.format(**values)
    except (KeyError, IndexError) as error:
        raise SequenceError(
            f"{key}: {pattern!r} has the unknown placeholder {error}.{closest(str(error.args[0]), _PLACEHOLDERS)} "
            f"Examples: {_EXAMPLE}."
        ) from error
    except (ValueError, AttributeError) as error:
        raise SequenceError(
            f"{key}: {pattern!r} cannot be filled in with {values}: {error}. Examples: {_EXAMPLE}."
        ) from error


def is_per_frame(pattern: str) -> bool:
    """Whether the pattern gives every frame a name of its own."""
    return re.search(r"\{(frame|index)\b", pattern) is not None


def is_glob(pattern: str) -> bool:
    """Whether the pattern stands for the sorted files that match it."""
    return "*" in pattern or "?" in pattern


def frame_files(
    folder: Path, pattern: str, key: str, *, frame_ids: Sequence[str], domain: str, camera: str
) -> tuple[Path, ...]:
    """One path per frame, in the frames' order; the files need not exist.

    Raises:
        SequenceError: a wrong pattern, or a glob that matches another number of files than there are frames.
    """
    if is_per_frame(pattern):
        return tuple(
            folder / expand(pattern, key, frame=FrameId(frame_id), index=row, domain=domain, camera=camera)
            for row, frame_id in enumerate(frame_ids)
        )
    filled = expand(pattern, key, domain=domain, camera=camera)
    base = folder / filled
    fixed = next(parent for parent in base.parents if not is_glob(str(parent)))
    found = sorted((path for path in fixed.glob(str(base.relative_to(fixed))) if path.is_file()), key=_natural)
    if len(found) != len(frame_ids):
        raise SequenceError(
            f"{key}: {filled!r} matches {len(found)} files in {fixed}, but the kinematics table has "
            f"{len(frame_ids)} rows. The n-th file belongs to the n-th row: make them as many, "
            "or name the files by frame, as in " + _EXAMPLE + "."
        )
    return tuple(found)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which `frame9` comes before `frame10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
