"""TOML tables with typed access to keys, and errors for wrong, missing and unknown keys."""

import difflib
from pathlib import Path
from typing import Any

from ..errors import SequenceError
from ..files import allowed_names, name_fault
from ..files.reading import SEQUENCE, all_finite, check_path, parse_toml, read_text
from ..wording import closest, listed, shown

_MAX_COMPARED = 200
"""Maximum number of keys that are compared for misspellings."""
_REQUIRED: Any = object()
_KINDS = {str: "text", bool: "true or false", dict: "a table", list: "a list", float: "a number", int: "a whole number"}


def read_toml(path: Path) -> "TomlTable":
    """Read the root table of a TOML file."""
    try:
        values = parse_toml(read_text(path, SEQUENCE))
    except FileNotFoundError as error:
        raise SequenceError(f"sequence file {path} is missing. Give the path of a .toml file.") from error
    except IsADirectoryError as error:
        raise SequenceError(f"{path} is a folder. Give the .toml file inside it.") from error
    except (OSError, ValueError) as error:
        raise SequenceError(
            f"sequence file {path} is not readable TOML: {error}. Compare it with docs/reference/sequence_format.md."
        ) from error
    return TomlTable(values, path, "")


class TomlTable:
    """Table of a TOML file. Keys are read one by one; `finish` raises an error for the remaining, unknown keys."""

    def __init__(self, values: dict[str, Any], file: Path, where: str, prefix: str = "") -> None:
        self.file = file
        self.where = where
        self._prefix = prefix
        self._values = values
        self._known: list[str] = []

    def name(self, key: str) -> str:
        """Full name of a key for errors, such as `sequence.toml: [[cameras]] 'left': size`."""
        return f"{self.file}: {self.where + ': ' if self.where else ''}{key}"

    def error(self, key: str, text: str) -> SequenceError:
        """Create an error about a key."""
        return SequenceError(f"{self.name(key)} {text}")

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def take(self, key: str, kind: Any = object, default: Any = _REQUIRED) -> Any:
        """Read the value of `key`.

        Args:
            key: name of the key.
            kind: type of the value (or a tuple of types); `float` also accepts integers, `object` accepts anything.
            default: value if the key is absent; without a default the key is required.
        """
        self._known.append(key)
        if key not in self._values:
            if default is _REQUIRED:
                given = [name for name in self._values if name not in self._known][:_MAX_COMPARED]
                matches = difflib.get_close_matches(key, given, n=1, cutoff=0.5)
                typo = f" Is {matches[0]!r} a misspelling of it?" if matches else ""
                raise self.error(key, f"is missing. Add it (docs/reference/sequence_format.md).{typo}")
            return default
        value = self._values[key]
        kinds = kind if isinstance(kind, tuple) else (kind,)
        accepted = tuple(extra for one in kinds for extra in ((int, float) if one is float else (one,)))
        if not isinstance(value, accepted) or (isinstance(value, bool) and bool not in kinds and object not in kinds):
            wanted = " or ".join(_KINDS[one] for one in kinds)
            raise self.error(key, f"is {shown(value)}, but must be {wanted}.")
        # Numbers in nested tables are checked when they are read, so that errors name their key.
        has_tables = isinstance(value, dict) or (isinstance(value, list) and any(isinstance(v, dict) for v in value))
        if not has_tables and not all_finite(value):
            raise self.error(key, f"is {shown(value)}, but must be a finite number.")
        return value

    def take_choice(self, key: str, choices: tuple[str, ...], default: str) -> str:
        """Read the string of `key`, one of `choices`."""
        value = self.take(key, str, default)
        if value not in choices:
            raise self.error(
                key, f"is {shown(value)}, but must be one of: {', '.join(choices)}.{closest(value, choices)}"
            )
        return value

    def take_table(self, key: str) -> "TomlTable":
        """Read the table `[key]`; empty if absent."""
        place = f"{self.where}: " if self.where else ""
        return TomlTable(self.take(key, dict, {}), self.file, f"{place}[{self._prefix}{key}]")

    def take_tables(self, key: str) -> list["TomlTable"]:
        """Read the array of tables `[[key]]`: at least one table, each with a unique `name`."""
        values = self.take(key, list, [])
        if not values or not all(isinstance(value, dict) for value in values):
            raise self.error(f"[[{key}]]", f"is missing. Add at least one table [[{key}]].")
        tables: list[TomlTable] = []
        names: list[str] = []
        for number, value in enumerate(values, start=1):
            name = TomlTable(value, self.file, f"[[{key}]] number {number}").take("name", str)
            if name in names:
                raise self.error(f"[[{key}]]", f"has the name {name!r} twice. Names must be unique.")
            names.append(name)
            check_file_name(self, f"[[{key}]]", "has the name", name)
            table = TomlTable(value, self.file, f"[[{key}]] {name!r}", f"{key}.")
            table.take("name", str)
            tables.append(table)
        return tables

    def items(self) -> dict[str, Any]:
        """All entries of a table with user-defined keys."""
        self._known.extend(self._values)
        return dict(self._values)

    def path(self, value: str) -> Path:
        """Absolute path of a path relative to the file's folder."""
        try:
            check_path(value)
            if "\0" in value:
                raise ValueError("it has a null character")
        except ValueError as error:
            raise SequenceError(f"{self.file}: {shown(value)} is not a valid path: {error}.") from error
        return self.file.parent / value

    def finish(self) -> None:
        """Check that all keys are known to the format."""
        for key in self._values:
            if key not in self._known:
                known = list(dict.fromkeys(self._known))
                listing = listed(known) or "none"
                raise self.error(key, f"is not a key of the format.{closest(key, known)} Known here: {listing}.")


def check_file_name(table: TomlTable, key: str, verb: str, name: str) -> None:
    """Check that a name can be part of file names."""
    if fault := name_fault(name):
        raise table.error(key, f"{verb} {name!r}, {fault}. {allowed_names()}.")
