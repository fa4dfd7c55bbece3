"""What every value from a browser goes through before it becomes part of the state."""

import math
from collections.abc import Collection

from carts_core.errors import CartsError
from carts_viewer.intents import Intent


def finite(value: float) -> float:
    """The number.

    Raises:
        CartsError: it is not finite.
    """
    if not math.isfinite(value):
        raise CartsError(f"{value} is not a number that a control can be set to.")
    return float(value)


def clamped(value: float, low: float, high: float) -> float:
    """The number, or the end of the range that it is beyond.

    Raises:
        CartsError: it is not finite.
    """
    return min(max(finite(value), low), high)


def one_of(asked: str | None, now: str, known: Collection[str], what: str) -> str:
    """The name that is asked for, by default the present one.

    Raises:
        CartsError: there is no such thing.
    """
    if asked is None:
        return now
    if asked not in known:
        raise CartsError(f"There is no {what} called {asked!r}; this sequence has: {', '.join(known)}.")
    return asked


def unknown(intent: Intent) -> CartsError:
    """The error for an intent that nothing handles."""
    return CartsError(f"The viewer does not know what to do with {type(intent).__name__}; this is a bug.")
