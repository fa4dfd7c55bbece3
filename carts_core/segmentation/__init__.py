"""Masks of what a person points at: a protocol for segmenters and the one that ships.

`onnx_segmenter` loads SAM-type models; it needs ONNX Runtime, which nothing else here does.
"""

from .builtin import NetworkSegmenter as NetworkSegmenter
from .builtin import instrument_probability as instrument_probability
from .prompt import Prompt as Prompt
from .prompt import Segmenter as Segmenter
