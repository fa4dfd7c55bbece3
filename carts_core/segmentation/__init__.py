"""Interactive segmentation: protocol of segmenters, and the built-in segmenter.

`onnx_segmenter` loads SAM-type models; only this module requires ONNX Runtime.
"""

from .segmenter import NetworkSegmenter as NetworkSegmenter
from .segmenter import Prompt as Prompt
from .segmenter import Segmenter as Segmenter
from .segmenter import instrument_probability as instrument_probability
