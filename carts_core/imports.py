"""Imports: optional packages, and many modules at once."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from .errors import CartsError


def needs_extra(module: str, extra: str) -> None:
    """See that a module of an optional dependency is there.

    Args:
        module: what will be imported.
        extra: of this project, which brings it.

    Raises:
        CartsError: it is not installed.
    """
    try:
        found = find_spec(module)
    except (ModuleNotFoundError, ValueError):
        found = None
    if found is None:
        raise CartsError(
            f"this needs the package {module}, which is not installed. Install it: pip install 'carts[{extra}]'"
        )


@contextmanager
def uncollected() -> Iterator[None]:
    """Have Python look for no garbage in the block: modules have none, and the viewer starts 0.6 s sooner."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class _Later(ModuleType):
    """Stands for a module, which is imported when something of it is asked for."""

    def __getattr__(self, name: str) -> object:
        return getattr(import_module(self.__name__), name)


@contextmanager
def deferred(package: str, name: str) -> Iterator[None]:
    """`from package import name` in the block, name being a module, imports it where it is first used: maybe never."""
    whole = f"{package}.{name}"
    if whole in sys.modules:
        yield
        return
    parent = import_module(package)
    setattr(parent, name, _Later(whole))
    try:
        yield
    finally:
        delattr(parent, name)
