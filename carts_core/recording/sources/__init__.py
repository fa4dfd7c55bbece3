"""One module per foreign format; the first one that detects a path reads it."""

from .bag import SOURCE as _BAG
from .protocol import Source as Source

SOURCES: tuple[Source, ...] = (_BAG,)
"""In the order in which they are tried: those with clear signs first."""
