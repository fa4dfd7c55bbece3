"""Interactive segmentation: protocol of segmenters, and the built-in segmenter.

`onnx_segmenter` loads SAM-type models; it is the only module of this package that requires ONNX Runtime.
"""

from .segmenter import NetworkSegmenter as NetworkSegmenter
from .segmenter import Prompt as Prompt
from .segmenter import Segmenter as Segmenter
from .segmenter import instrument_probability as instrument_probability
