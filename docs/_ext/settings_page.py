"""One page with every settings dataclass: name, type, default and meaning of each field, from the source."""

import dataclasses
import inspect
import pkgutil
import typing
from importlib import import_module
from pathlib import Path

from sphinx.pycode import ModuleAnalyzer

import carts_core.settings


def settings_page() -> str:
    """The page, in Markdown."""
    parts = [
        "# Settings",
        "Settings of runs and commands. Each class is a frozen dataclass of `carts_core.settings`, which checks its "
        "ranges; options of the [commands](../cli.md) are made from the same fields. A value outside its range is "
        "refused with a message that states the range.",
    ]
    for module in pkgutil.iter_modules(carts_core.settings.__path__, f"{carts_core.settings.__name__}."):
        for name, cls in vars(import_module(module.name)).items():
            if inspect.isclass(cls) and dataclasses.is_dataclass(cls) and cls.__module__ == module.name:
                parts.append(_section(name, cls))
    return "\n\n".join(parts) + "\n"


def _section(name: str, cls: type) -> str:
    documentation = ModuleAnalyzer.for_module(cls.__module__).find_attr_docs()
    rows = ["| field | type | default | meaning |", "|---|---|---|---|"]
    for field in dataclasses.fields(cls):
        meaning = " ".join(documentation.get((cls.__name__, field.name), ["-"])).strip()
        rows.append(f"| `{field.name}` | {_code(_type(field.type))} | {_code(_default(field))} | {_cell(meaning)} |")
    title = f"## {name}\n\n" if cls.__doc__ is None else f"## {name}\n\n{inspect.cleandoc(cls.__doc__)}\n\n"
    return title + "\n".join(rows)


def _type(annotation: typing.Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return " or ".join(repr(choice) for choice in typing.get_args(annotation))
    return annotation.__name__ if inspect.isclass(annotation) and not typing.get_args(annotation) else str(annotation)


def _default(field: dataclasses.Field) -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "required"
    if dataclasses.is_dataclass(value):
        return f"{type(value).__name__}(...)"
    if isinstance(value, tuple) and value and all(dataclasses.is_dataclass(one) for one in value):
        return f"({', '.join(type(one).__name__ for one in value)})"
    return value.name if isinstance(value, Path) else repr(value)


def _code(text: str) -> str:
    return "`" + _cell(text.replace("typing.", "")) + "`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
