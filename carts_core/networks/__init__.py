"""Inference of the networks, and hybrid images."""

from .extractor import FeatureExtractor as FeatureExtractor
from .extractor import hybrid as hybrid
