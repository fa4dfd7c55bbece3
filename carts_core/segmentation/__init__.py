"""Masks of what a person points at: a protocol for segmenters and the one that ships.

`onnx_segmenter` loads SAM-type models; it needs ONNX Runtime, which nothing else here does.
"""

from .segmenter import NetworkSegmenter as NetworkSegmenter
from .segmenter import Prompt as Prompt
from .segmenter import Segmenter as Segmenter
from .segmenter import instrument_probability as instrument_probability
