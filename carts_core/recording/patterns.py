"""Names of files per frame: `left/{frame}.jpg`, `{domain}/{index:06d}.png`, `left/*.jpg`."""

import re
from functools import lru_cache
from string import Formatter

from ..errors import SequenceError
from ..files.reading import LARGEST_NAME, check_path
from ..wording import closest, shown

_WIDTH_DIGITS = 6
_PLACEHOLDERS = ("frame", "index", "domain", "camera")
EXAMPLES = '"left/{frame}.jpg", "left/{frame:06d}.png", "{domain}/{index:04d}.jpg"'


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
        _check_format(pattern)
        filled = pattern.format(**values)
        check_path(filled)
    except KeyError as error:
        raise SequenceError(
            f"{key}: {shown(pattern)} has the unknown placeholder {error}.{closest(str(error.args[0]), _PLACEHOLDERS)} "
            f"Examples: {EXAMPLES}."
        ) from error
    except ValueError as error:
        raise SequenceError(
            f"{key}: {shown(pattern)} cannot be filled in with {shown(values)}: {error}. Examples: {EXAMPLES}."
        ) from error
    return filled


@lru_cache(maxsize=64)
def _check_format(pattern: str) -> None:
    """Check that a pattern has nothing but placeholders, padded to a width that a file's name can have.

    Raises:
        KeyError: a placeholder is unknown, or asks for a part of a value.
        ValueError: a format is malformed, nested or too wide.
    """
    for _, name, form, conversion in Formatter().parse(pattern):
        if name is None:
            continue
        if name not in _PLACEHOLDERS:
            raise KeyError(name)
        if conversion or "{" in (form or ""):
            raise ValueError("a placeholder takes a width such as 06d, and nothing else")
        if any(len(width) > _WIDTH_DIGITS or int(width) > LARGEST_NAME for width in re.findall(r"[0-9]+", form or "")):
            raise ValueError(f"a name is longer than {LARGEST_NAME} characters")


def is_per_frame(pattern: str) -> bool:
    """Whether the pattern gives every frame a name of its own."""
    return re.search(r"\{(frame|index)\b", pattern) is not None


def is_glob(pattern: str) -> bool:
    """Whether the pattern stands for the sorted files that match it."""
    return "*" in pattern or "?" in pattern
