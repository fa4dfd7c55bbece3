"""The file of every frame, by a pattern."""

import re
from pathlib import Path

from ..errors import SequenceError
from ..files.reading import is_regular
from ..wording import counted
from .frame_list import FrameList
from .patterns import EXAMPLES, FrameId, expand, is_glob, is_per_frame

_SHOWN_MISSING = 3
_MOST_WILD_PARTS = 2


def frame_files(
    folder: Path, pattern: str, key: str, frames: FrameList, *, domain: str, camera: str
) -> tuple[Path, ...]:
    """One path per frame, in the frames' order; the files need not exist.

    Raises:
        SequenceError: a wrong pattern, or a glob that matches another number of files than there are frames.
    """
    if is_per_frame(pattern):
        return tuple(
            folder / expand(pattern, key, frame=FrameId(frame_id), index=row, domain=domain, camera=camera)
            for row, frame_id in enumerate(frames.frame_ids)
        )
    filled = expand(pattern, key, domain=domain, camera=camera)
    fixed, found = _matching(folder / filled, key)
    if len(found) != len(frames.frame_ids):
        raise SequenceError(
            f"{key}: {filled!r} matches {counted(len(found), 'file')} in {fixed}, but {frames.counted}. "
            f"The n-th file belongs to the n-th of them: make them as many, "
            "or name the files by frame, as in " + EXAMPLES + "."
        )
    return tuple(found)


def _matching(base: Path, key: str) -> tuple[Path, list[Path]]:
    """The folder above the first wildcard, and the files below it that match, in natural order."""
    fixed = next(parent for parent in base.parents if not is_glob(str(parent)))
    wild = base.relative_to(fixed)
    if "**" in wild.parts or len(wild.parts) > _MOST_WILD_PARTS:
        raise SequenceError(
            f"{key}: {str(wild)!r} would search whole trees of folders. Wildcards are allowed from the last "
            f"{_MOST_WILD_PARTS} parts of the path on, and ** is not; name the folder."
        )
    try:
        return fixed, sorted(filter(is_regular, fixed.glob(str(wild))), key=_natural)
    except (ValueError, OSError) as error:
        raise SequenceError(f"{key}: {str(wild)!r} cannot be searched for: {error}. Examples: {EXAMPLES}.") from error


def check_present(key: str, files: tuple[Path, ...], frames: FrameList, hint: str = "") -> None:
    """Check that every frame's file is there.

    Raises:
        SequenceError: some are not.
    """
    missing = [(file, frame_id) for file, frame_id in zip(files, frames.frame_ids, strict=True) if not is_regular(file)]
    if missing:
        shown = ", ".join(f"{file} (frame {frame_id})" for file, frame_id in missing[:_SHOWN_MISSING])
        rest = f" and {len(missing) - _SHOWN_MISSING} more" if len(missing) > _SHOWN_MISSING else ""
        raise SequenceError(
            f"{key}: {len(missing)} of {counted(len(files), 'file')} missing: {shown}{rest}, but {frames.counted} "
            f"and every one needs its file: put them back, correct the pattern, or remove the rows.{hint}"
        )


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which `frame9` comes before `frame10`."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
