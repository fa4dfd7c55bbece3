"""Packages that only some commands need."""

from importlib.util import find_spec

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
