"""Presets of the solver's settings: a name, what they are for, and what they change."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import reduced


@dataclass(frozen=True)
class Preset:
    """Settings that belong together."""

    meaning: str
    """When to take it, for people."""
    changes: Callable[[SurfaceSolver], dict[str, Any]]
    """What differs from the default settings of a solver of surface maps; others have no presets but the default."""


PRESETS = {
    "Default": Preset("As the solver ships.", lambda _: {}),
    "Quick": Preset("Smaller images: sooner, and less exact.", lambda solver: {"stages": reduced(solver.stages, 0.75)}),
    "Far off": Preset("Measured joints that are wrong by more than 3 degrees.", lambda _: {"prior_deg": 6.0}),
    "Well calibrated": Preset("Measured joints that are right to about a degree.", lambda _: {"prior_deg": 1.0}),
    "Smoke and haze": Preset("All haze is taken off before images are compared.", lambda _: {"dehaze": 1.0}),
}
"""By their names, the default first."""
