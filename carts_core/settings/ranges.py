"""Ranges of settings as type annotations, and their validation."""

from dataclasses import dataclass, fields
from math import inf
from typing import Annotated

from ..errors import SettingsError


@dataclass(frozen=True)
class Range:
    """Allowed values of a field, or of each element of a tuple, such as `Annotated[float, Range(0, 1)]`."""

    low: float = -inf
    high: float = inf
    unit: str = ""
    above: bool = False
    """Whether `low` itself is excluded."""
    below: bool = False
    """Whether `high` itself is excluded."""

    def holds(self, value: float) -> bool:
        """Whether a value is in the range; False for NaN."""
        return (self.low < value if self.above else self.low <= value) and (
            value < self.high if self.below else value <= self.high
        )

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.above or self.below:
            low = f"above {self.low:g}" if self.above else f"at least {self.low:g}"
            high = f", below {self.high:g}" if self.below else f", at most {self.high:g}"
            return low + (high if self.high < inf else "") + unit
        return (f"{self.low:g} to {self.high:g}" if self.high < inf else f"{self.low:g} or more") + unit


Share = Annotated[float, Range(0, 1)]
"""Number from 0 to 1."""
Count = Annotated[int, Range(1)]
"""Positive integer."""
Positive = Annotated[float, Range(0, above=True)]
"""Positive number."""
NotNegative = Annotated[float, Range(0)]
"""Nonnegative number."""


def require(condition: bool, name: str, value: object, allowed: object) -> None:
    """Check a setting; `SettingsError` if the condition is false."""
    if not condition:
        raise SettingsError(f"{name} is {value!r}; allowed: {allowed}. Change it, or use the default.")


class Ranged:
    """Base of dataclasses with `Range` annotations; None is allowed if the type includes it."""

    @classmethod
    def label(cls, field: str) -> str:
        """Name of a field in messages."""
        return f"{cls.__name__}.{field}"

    def __post_init__(self) -> None:
        """Check all ranges; `SettingsError` for a value out of range."""
        for field in fields(self):  # pyright: ignore[reportArgumentType]
            for allowed in getattr(field.type, "__metadata__", ()):
                value = getattr(self, field.name)
                if isinstance(allowed, Range) and value is not None:
                    inside = all(map(allowed.holds, value if isinstance(value, tuple) else (value,)))
                    require(inside, self.label(field.name), value, allowed)
