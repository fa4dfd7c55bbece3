"""Recordings: the sequence format and its loader."""

from .sequence import Frame as Frame
from .sequence import Sequence as Sequence
