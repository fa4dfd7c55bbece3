"""Names of files per frame: `left/{frame}.jpg`, `{domain}/{index:06d}.png`, `left/*.jpg`."""

import re

from ..errors import SequenceError
from .toml_table import closest

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
        return pattern.format(**values)
    except (KeyError, IndexError) as error:
        raise SequenceError(
            f"{key}: {pattern!r} has the unknown placeholder {error}.{closest(str(error.args[0]), _PLACEHOLDERS)} "
            f"Examples: {EXAMPLES}."
        ) from error
    except (ValueError, AttributeError) as error:
        raise SequenceError(
            f"{key}: {pattern!r} cannot be filled in with {values}: {error}. Examples: {EXAMPLES}."
        ) from error


def is_per_frame(pattern: str) -> bool:
    """Whether the pattern gives every frame a name of its own."""
    return re.search(r"\{(frame|index)\b", pattern) is not None


def is_glob(pattern: str) -> bool:
    """Whether the pattern stands for the sorted files that match it."""
    return "*" in pattern or "?" in pattern
