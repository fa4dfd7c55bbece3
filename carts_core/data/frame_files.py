"""The file of every frame, by a pattern."""

import re
from pathlib import Path

from ..errors import SequenceError
from ..wording import counted
from .frame_list import FrameList
from .patterns import EXAMPLES, FrameId, expand, is_glob, is_per_frame

_SHOWN_MISSING = 3


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
    base = folder / filled
    fixed = next(parent for parent in base.parents if not is_glob(str(parent)))
    found = sorted((path for path in fixed.glob(str(base.relative_to(fixed))) if path.is_file()), key=_natural)
    if len(found) != len(frames.frame_ids):
        raise SequenceError(
            f"{key}: {filled!r} matches {counted(len(found), 'file')} in {fixed}, but {frames.counted}. "
            f"The n-th file belongs to the n-th of them: make them as many, "
            "or name the files by frame, as in " + EXAMPLES + "."
        )
    return tuple(found)


def check_present(key: str, files: tuple[Path, ...], frames: FrameList, hint: str = "") -> None:
    """Check that every frame's file is there.

    Raises:
        SequenceError: some are not.
    """
    missing = [(file, frame_id) for file, frame_id in zip(files, frames.frame_ids, strict=True) if not file.is_file()]
    if missing:
        shown = ", ".join(f"{file} (frame {frame_id})" for file, frame_id in missing[:_SHOWN_MISSING])
        rest = f" and {len(missing) - _SHOWN_MISSING} more" if len(missing) > _SHOWN_MISSING else ""
        raise SequenceError(
            f"{key}: {len(missing)} of {counted(len(files), 'file')} missing: {shown}{rest}, but {frames.counted} "
            f"and every one needs its file: put them back, correct the pattern, or remove the rows.{hint}"
        )


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key by which `frame9` comes before `frame10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
