"""Short `repr` of objects that contain arrays: shapes and types instead of values."""

from collections.abc import Mapping
from dataclasses import fields
from enum import Enum
from itertools import islice
from pathlib import Path
from typing import Any

from .wording import shortened

MAX_SHOWN_VALUES = 8
"""Maximum length of a vector whose values are shown."""
_MAX_ITEMS = 6
_MAX_TEXT = 120
_MAX_DEPTH = 4


def short_repr(self: Any) -> str:
    """`repr` of a dataclass instance; assign it to `__repr__` in the body of the class.

    Arrays and tensors are shown as `float32[480, 640]`, vectors of at most 8 values with 4 digits, and long collections
    by their first items.
    """
    inside = ", ".join(f"{field.name}={_short(getattr(self, field.name))}" for field in fields(self) if field.repr)
    return f"{type(self).__name__}({inside})"


def _short(value: Any, depth: int = 0) -> str:
    if isinstance(value, Mapping | tuple | list):
        return _collection(value, depth)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return _array(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return shortened(repr(value), _MAX_TEXT) if isinstance(value, str | Path | Enum) else repr(value)


def _collection(value: Mapping | tuple | list, depth: int) -> str:
    if depth >= _MAX_DEPTH:
        return "..."
    more = [f"... {len(value) - _MAX_ITEMS} more"] if len(value) > _MAX_ITEMS else []
    if isinstance(value, Mapping):
        shown = [f"{_short(key)}: {_short(one, depth + 1)}" for key, one in islice(value.items(), _MAX_ITEMS)]
        return "{" + ", ".join(shown + more) + "}"
    shown = ", ".join([_short(one, depth + 1) for one in value[:_MAX_ITEMS]] + more)
    return f"[{shown}]" if isinstance(value, list) else f"({shown}{',' if len(value) == 1 else ''})"


def _array(value: Any) -> str:
    shape = list(value.shape)
    if len(shape) <= 1 and (not shape or shape[0] <= MAX_SHOWN_VALUES):
        values = value.tolist()
        shown = [f"{one:.4g}" if isinstance(one, float) else str(one) for one in (values if shape else [values])]
        return f"[{', '.join(shown)}]" if shape else shown[0]
    return f"{str(value.dtype).removeprefix('torch.')}{shape}"
