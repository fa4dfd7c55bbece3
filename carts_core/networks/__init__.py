"""The feature network: inference, hybrid images and training."""

from .extractor import FeatureExtractor as FeatureExtractor
from .hybrid import hybrid as hybrid

__all__ = ["FeatureExtractor", "hybrid"]
