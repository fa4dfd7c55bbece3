"""What a table of the report is, and how numbers are written in it."""

from . import paper
from .occlusion import OCCLUSION
from .statistics import Spread

DOMAIN_LABELS = {
    "regular": "regular",
    "low_brightness": "low brightness",
    "bleeding": "bleeding",
    "smoke": "smoke",
    "background_change": "background change",
    "simulated_smoke": "simulated smoke",
    OCCLUSION: "occlusion",
}
SHORT_LABELS = {"paper": "paper's setting", "ours": "ours"}
"""Of the methods that are followed through iterations and errors."""
NOTHING = "–"
"""In place of a number that is not there."""


def begun(error_deg: float | None) -> str:
    """Where a run started."""
    return "as measured" if error_deg is None else f"{error_deg:g}°"


def spread_text(spread: Spread | None, scale: float = 100.0, digits: int = 1) -> str:
    """Mean ± standard deviation, Dice and NSD in percent by default; of a single frame there is no deviation."""
    if spread is None:
        return NOTHING
    if spread.count == 1:
        return f"{scale * spread.mean:.{digits}f}"
    return f"{scale * spread.mean:.{digits}f} ± {scale * spread.deviation:.{digits}f}"


def paper_note(value: paper.Value | None, column: str | None, digits: int = 1) -> str:
    """The paper's number and the column where it stands there."""
    if value is None:
        return ""
    return f"{column} {value[0]:.{digits}f} ± {value[1]:.{digits}f}"
