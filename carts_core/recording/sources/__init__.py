"""One module per foreign format; the first one that detects a path reads it."""

from .bag import SOURCE as _BAG
from .folder import SOURCE as _FOLDER
from .protocol import Source as Source

SOURCES: tuple[Source, ...] = (_BAG, _FOLDER)
"""In the order in which they are tried: those with clear signs first, what fits nearly everything last."""
