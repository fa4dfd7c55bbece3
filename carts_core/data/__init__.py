"""Recordings: the sequence format and its loader."""

from .frame_reader import FrameReader as FrameReader
from .sequence import Frame as Frame
from .sequence import Sequence as Sequence
