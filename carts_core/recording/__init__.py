"""Recordings: the sequence format and its loader. Invalid or missing content raises `SequenceError`."""

from .background import MeanBackground as MeanBackground
from .background import background_of_recording as background_of_recording
from .background import evenly_spaced as evenly_spaced
from .sequence import Frame as Frame
from .sequence import FrameReader as FrameReader
from .sequence import Sequence as Sequence
from .sequence_file import calibrated_sequence_file as calibrated_sequence_file
from .time_delay import TimeOffsetEstimate as TimeOffsetEstimate
from .time_delay import estimate_time_offsets as estimate_time_offsets
from .time_delay import offsets_to_write as offsets_to_write
