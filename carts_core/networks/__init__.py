"""The feature network: inference, hybrid images and training."""

from .extractor import FeatureExtractor as FeatureExtractor
from .extractor import hybrid as hybrid

__all__ = ["FeatureExtractor", "hybrid"]
