"""Foreign recording formats; the first that detects a path reads it. Unusable content raises `SequenceError`."""

from ..importing.found import Source as Source
from . import bag as _bag
from . import datasets as _datasets
from . import dvrk_recorder as _dvrk_recorder
from . import folder as _folder
from . import lerobot as _lerobot

SOURCES: tuple[Source, ...] = (
    _dvrk_recorder.SOURCE,
    _bag.SOURCE,
    _lerobot.SOURCE,
    _datasets.SURGSYNC,
    _datasets.CTS,
    _datasets.AMBF,
    _datasets.SEGSTRONG_C,
    _datasets.SURGPOSE,
    _datasets.ENDOVIS,
    _datasets.JIGSAWS,
    _folder.SOURCE,
)
"""Sources in order of detection, from the most specific to the generic folder."""
