"""Foreign recording formats; the first that detects a path reads it. Unusable content raises `SequenceError`."""

from ..importing.found import Source as Source
from .bag import SOURCE as _BAG
from .carts_layouts import AMBF as _AMBF
from .carts_layouts import CTS as _CTS
from .carts_layouts import SEGSTRONG_C as _SEGSTRONG_C
from .datasets import ENDOVIS as _ENDOVIS
from .datasets import JIGSAWS as _JIGSAWS
from .datasets import SURGPOSE as _SURGPOSE
from .datasets import SURGSYNC as _SURGSYNC
from .dvrk_recorder import SOURCE as _DVRK
from .folder import SOURCE as _FOLDER
from .lerobot import SOURCE as _LEROBOT

SOURCES: tuple[Source, ...] = (
    _DVRK,
    _BAG,
    _LEROBOT,
    _SURGSYNC,
    _CTS,
    _AMBF,
    _SEGSTRONG_C,
    _SURGPOSE,
    _ENDOVIS,
    _JIGSAWS,
    _FOLDER,
)
"""Sources in order of detection: the most specific first, the generic folder last."""
