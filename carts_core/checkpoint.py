"""Checkpoints of intermediate results, from which a stopped run resumes with an identical result.

The key of an entry is a hash of all inputs of its computation, so entries do not depend on the order of computation,
and a changed input invalidates them. Truncated or altered lines are ignored.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from .errors import OutputError
from .files import OutputPath, append_line, holds_file, remove_file, write_text
from .fingerprints import fingerprint
from .stopping import finished_first

_FORMAT = "carts-checkpoint/1"
_DIGITS = 32
Value = TypeVar("Value")


class Checkpoint:
    """File of intermediate results.

    Args:
        made_with: fingerprint of the common inputs; a file with a different fingerprint is replaced.
        classes: the frozen dataclasses that values may contain, besides numbers, lists and float64 arrays.

    Attributes:
        recalled: number of values read from the file.
    """

    def __init__(self, path: OutputPath, made_with: str, classes: Sequence[type]) -> None:
        self._path, self._made_with = path, made_with
        self._classes = {kind.__name__: kind for kind in classes}
        self._entries = self._read()
        self._begun = bool(self._entries)
        self.recalled = 0

    def value(self, key: str, compute: Callable[[], Value]) -> Value:
        """Return the stored value of a key, or compute and store it.

        Raises:
            OutputError: the file cannot be written.
        """
        if key in self._entries:
            self.recalled += 1
            return self._decoded(self._entries[key])
        found = compute()
        with finished_first():
            if not self._begun:
                write_text(self._path, f"{_FORMAT} {self._made_with}\n")
                self._begun = True
            text = json.dumps(_encoded(found))
            append_line(self._path, f"{key} {fingerprint(key, text)[:_DIGITS]} {text}".encode())
        return found

    def remove(self) -> None:
        """Remove the file after the results are written."""
        remove_file(self._path)

    def _read(self) -> dict[str, Any]:
        if not holds_file(self._path):
            return {}
        try:
            lines = self._path.path.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError as error:
            raise OutputError(f"{self._path} cannot be read ({error.strerror}). Remove it to start over.") from error
        if not lines or lines[0] != f"{_FORMAT} {self._made_with}":
            return {}
        entries = {}
        for line in lines[1:]:
            key, _, rest = line.partition(" ")
            check, _, text = rest.partition(" ")
            if check == fingerprint(key, text)[:_DIGITS]:
                entries[key] = json.loads(text)
        return entries

    def _decoded(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._decoded(part) for part in value]
        if not isinstance(value, Mapping):
            return value
        if "array" in value:
            return np.array(value["array"], np.float64).reshape(value["shape"])
        return self._classes[value["class"]](**{name: self._decoded(part) for name, part in value["fields"].items()})


def _encoded(value: Any) -> Any:
    """The value as JSON; float64 values keep all bits."""
    if isinstance(value, np.ndarray):
        assert value.dtype == np.float64
        return {"array": value.ravel().tolist(), "shape": value.shape}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: _encoded(getattr(value, field.name)) for field in fields(value)}
        return {"class": type(value).__name__, "fields": parts}
    if isinstance(value, list):
        return [_encoded(part) for part in value]
    return value
