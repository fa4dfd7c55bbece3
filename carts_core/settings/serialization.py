"""Conversion of settings to and from plain data, for results and settings files, and documentation of their fields."""

import ast
import inspect
import textwrap
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from enum import StrEnum
from functools import cache
from typing import Any, TypeVar, get_args, get_type_hints

from ..errors import SettingsError
from ..wording import closest
from .stages import Stage


@cache
def field_docstrings(kind: type) -> dict[str, str]:
    """Docstring of each field of a dataclass, read from the source."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr):
            found[field.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return found


def described(kind: type) -> str:
    """Description of a settings dataclass: summary, and each field with default and meaning."""
    lines = [f"{kind.__name__}: {inspect.getdoc(kind) or ''}"]
    texts = field_docstrings(kind)
    for field in fields(kind):
        plain = field.default is not MISSING and not isinstance(field.default, tuple)
        default = f" = {field.default}" if plain else ""
        lines.append(
            textwrap.fill(
                f"{field.name}{default}: {texts.get(field.name, '')}",
                110,
                initial_indent="  ",
                subsequent_indent="      ",
            )
        )
    return "\n".join(lines)


_Settings = TypeVar("_Settings")
_STAGES: dict[str, type] = {kind.__name__: kind for kind in get_args(Stage)}


def to_plain(value: Any) -> Any:
    """Convert settings to numbers, strings, lists and dictionaries; the kind of a stage is stored under `stage`."""
    if is_dataclass(value) and not isinstance(value, type):
        kind = {"stage": type(value).__name__} if type(value).__name__ in _STAGES else {}
        return {**kind, **{field.name: to_plain(getattr(value, field.name)) for field in fields(value)}}
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, tuple | list):
        return [to_plain(one) for one in value]
    return value


def changed(base: _Settings, table: Mapping[str, Any], where: str) -> _Settings:
    """Replace fields of settings by those of a table; `SettingsError` for unknown fields or invalid values."""
    types = get_type_hints(type(base))
    values: dict[str, Any] = {}
    for name, value in table.items():
        if name not in types:
            raise SettingsError(f"{where} has no setting {name!r}.{closest(name, types)} Settings: {', '.join(types)}.")
        present = getattr(base, name)
        of_stages = name in ("stages", "then") or (
            isinstance(present, tuple) and any(type(one) in get_args(Stage) for one in present)
        )
        values[name] = _stages(value, f"{where}.{name}") if of_stages else _like(value, present, f"{where}.{name}")
    return replace(base, **values)  # pyright: ignore[reportArgumentType, reportCallIssue]


def _like(value: Any, present: Any, where: str) -> Any:
    """Convert a value to the type of the current one."""
    if isinstance(present, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(present, StrEnum) and isinstance(value, str):
        kind = type(present)
        if value not in set(kind):
            raise SettingsError(f"{where} is {value!r}; allowed: {', '.join(kind)}.")
        return kind(value)
    if isinstance(present, tuple) and isinstance(value, list):
        return tuple(value)
    if type(value) is not type(present):
        raise SettingsError(f"{where} is {value!r}; give a value such as {to_plain(present)!r}.")
    return value


def _stages(tables: Any, where: str) -> tuple[Stage, ...]:
    if not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
        raise SettingsError(f"{where} must be a list of tables, each with a key `stage`, as `--print-settings` writes.")
    return tuple(_stage(table, f"{where}[{index}]") for index, table in enumerate(tables))


def _stage(table: Mapping[str, Any], where: str) -> Stage:
    rest = dict(table)
    name = rest.pop("stage", None)
    if not isinstance(name, str) or name not in _STAGES:
        raise SettingsError(f"{where} has the stage {name!r}; allowed: {', '.join(_STAGES)}.")
    if name == "Descend" and "blur" not in rest:
        raise SettingsError(f"{where} (Descend) requires a blur [px], such as 1.6.")
    kind = _STAGES[name]
    required: dict[str, Any] = {"blur": 1.0, "then": ()}
    base = kind(**{field.name: required[field.name] for field in fields(kind) if field.default is MISSING})
    return changed(base, rest, f"{where} ({name})")
