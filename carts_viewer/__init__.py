"""The browser app: browse a sequence, move the arms by hand, run the optimizer, export masks."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .notebook import view as view


def __getattr__(name: str) -> object:
    # Imported on first use, since the viewer takes seconds to import.
    if name != "view":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .notebook import view  # noqa: PLC0415

    return view
