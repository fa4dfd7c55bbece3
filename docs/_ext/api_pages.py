"""A page for each public package and module of `carts_core`, with the docstrings of its public names."""

import importlib
import inspect
from collections.abc import Iterator
from types import ModuleType

PUBLIC = (
    "errors",
    "evaluation",
    "export",
    "fitting",
    "model.camera",
    "model.dvrk_model",
    "model.keypoints",
    "model.perturbation",
    "model.psm_kinematics",
    "model.robot",
    "model.scene",
    "networks",
    "optimization",
    "project",
    "recording",
    "recording.importing",
    "rendering",
    "resources",
    "lab.synthesis",
)
"""Public modules of `carts_core`, besides the settings, which have a page of their own."""


def api_pages() -> dict[str, str]:
    """File name -> Markdown."""
    pages = {}
    for name in PUBLIC:
        module = importlib.import_module(f"carts_core.{name}")
        names = list(_public_names(module, package=hasattr(module, "__path__")))
        pages[f"api_{name}.md"] = _page(module, names)
    return pages


def _public_names(module: ModuleType, package: bool) -> Iterator[str]:
    """Public classes and functions defined in a module, or exported by a package, in their order."""
    declared = getattr(module, "__all__", None) or dict.fromkeys([*vars(module), *dir(module)])
    for name in declared:
        value = getattr(module, name)
        if name.startswith("_") or not (inspect.isclass(value) or inspect.isfunction(value)):
            continue
        home = value.__module__
        if home == module.__name__ or (package and home.startswith(module.__name__ + ".")):
            yield name


def _page(module: ModuleType, names: list[str]) -> str:
    directives = []
    for name in names:
        kind = "autoclass" if inspect.isclass(getattr(module, name)) else "autofunction"
        directives.append(f".. {kind}:: {module.__name__}.{name}\n")
    summary = inspect.cleandoc(module.__doc__ or "")
    return f"# {module.__name__}\n\n{summary}\n\n```{{eval-rst}}\n" + "\n".join(directives) + "```\n"
