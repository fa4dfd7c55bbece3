"""Import of recordings from foreign formats; missing, damaged or contradictory content raises `SequenceError`."""

from ..matching import at_times as at_times
from .calibrations import DvrkBaseFrame as DvrkBaseFrame
from .calibrations import read_base_frames as read_base_frames
from .logs import CANDIDATES as CANDIDATES
from .logs import BaseFrame as BaseFrame
from .logs import InstrumentCheck as InstrumentCheck
from .logs import check_instrument as check_instrument
from .logs import clock_offset as clock_offset
from .logs import fit_base_frame as fit_base_frame
