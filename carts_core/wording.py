"""Wording of messages and reports."""

from collections.abc import Iterable
from difflib import get_close_matches
from itertools import islice

_MAX_COMPARED_LENGTH, _MAX_COMPARED = 100, 200
"""Maximum length of a misspelt name, and maximum number of known names that it is compared with; the cost grows with
the product of lengths."""


def counted(number: int, what: str) -> str:
    """Number with its noun in singular or plural, such as `1 run` and `2 runs`."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def duration_text(seconds: float) -> str:
    """Rounded duration, such as "40 s", "3 min" or "26.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def listed(names: Iterable[str], most: int = 40) -> str:
    """Names joined by commas, abbreviated if there are many."""
    names = iter(names)
    text = ", ".join(shortened(name) for name in islice(names, most))
    rest = sum(1 for _ in names)
    return f"{text} and {rest} more" if rest else text


def shortened(text: str, length: int = 200) -> str:
    """Replace the middle of a string by an ellipsis if it is longer than `length`."""
    return text if len(text) <= length else f"{text[: length - 40]} ... {text[-35:]}"


def shown(value: object, length: int = 200) -> str:
    """`repr` of a value for an error message, with its middle shortened."""
    return shortened(repr(value), length)


def closest(name: str, known: Iterable[str]) -> str:
    """Suggestion ` Did you mean 'X'?` if one of `known` resembles `name`, else empty. In numbers, only
    leading zeros are corrected."""
    known, number = list(known), name.lstrip("0")
    same = [one for one in known if one.casefold() == name.casefold()]
    same = same or [one for one in known if name.isdecimal() and one.lstrip("0") == number]
    if len(name) <= _MAX_COMPARED_LENGTH and not name.isdecimal():
        same = same or get_close_matches(name, known[:_MAX_COMPARED], n=1, cutoff=0.5)
    return f" Did you mean {same[0]!r}?" if same else ""
