"""Recordings of other people's formats, and what they know of themselves."""

from .alignment import at_times as at_times
from .alignment import clock_offset as clock_offset
from .dvrk_files import DvrkBaseFrame as DvrkBaseFrame
from .dvrk_files import read_base_frames as read_base_frames
from .instrument import CANDIDATES as CANDIDATES
from .instrument import BaseFrame as BaseFrame
from .instrument import InstrumentCheck as InstrumentCheck
from .instrument import check_instrument as check_instrument
from .instrument import fit_base_frame as fit_base_frame
