"""One line of the table of targets."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Target:
    """One line of the table."""

    what: str
    target: str
    reached: str
    met: bool | None
    """None where it is open: nothing was measured, or nothing that misses it, but not all that it asks for."""
    reference: str
    basis: str
    """What it was computed from."""


def make_target(
    what: str,
    least_or_most: float,
    value: float | None,
    basis: str,
    *,
    at_least: bool,
    text: Callable[[float], str],
    reference: str = "",
    complete: bool = True,
) -> Target:
    """A target with its verdict.

    Args:
        what: for people.
        least_or_most: the bound.
        value: what was reached; None where nothing was measured.
        basis: what it was computed from.
        at_least: whether the bound is the smallest value that meets it, or the largest.
        text: writes a value.
        reference: what others reached.
        complete: whether everything was measured that the target asks for; otherwise it cannot be met, only missed.
    """
    bound = f"at {'least' if at_least else 'most'} {text(least_or_most)}"
    if value is None:
        return Target(what, bound, "not measured", None, reference, basis)
    met = value >= least_or_most if at_least else value <= least_or_most
    near = not met and text(value) == text(least_or_most)
    reached = f"just {'below' if at_least else 'above'} {text(value)}" if near else text(value)
    return Target(what, bound, reached, met if complete or not met else None, reference, basis)
