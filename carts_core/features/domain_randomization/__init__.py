"""Training images for the feature network, made on the fly and varied far beyond any one operating room."""

from .pairs import BACKGROUND as BACKGROUND
from .pairs import HEAD as HEAD
from .pairs import SHAFT as SHAFT
from .pairs import PairGenerator as PairGenerator
from .pairs import PairSettings as PairSettings
from .pairs import TrainingPair as TrainingPair
from .ranges import AppearanceRanges as AppearanceRanges

__all__ = ["BACKGROUND", "HEAD", "SHAFT", "AppearanceRanges", "PairGenerator", "PairSettings", "TrainingPair"]
