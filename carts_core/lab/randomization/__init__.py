"""Training images for the networks, made on the fly and varied far beyond any one operating room."""

from ...settings import AppearanceRanges as AppearanceRanges
from ...settings import ImageSettings as ImageSettings
from .pairs import BACKGROUND as BACKGROUND
from .pairs import HEAD as HEAD
from .pairs import SHAFT as SHAFT
from .pairs import PairGenerator as PairGenerator
from .pairs import TrainingPair as TrainingPair
from .surfaces import SURFACE_UNIT as SURFACE_UNIT
from .surfaces import SurfaceGenerator as SurfaceGenerator
from .surfaces import SurfaceSample as SurfaceSample

__all__ = [
    "BACKGROUND",
    "HEAD",
    "SHAFT",
    "SURFACE_UNIT",
    "AppearanceRanges",
    "ImageSettings",
    "PairGenerator",
    "SurfaceGenerator",
    "SurfaceSample",
    "TrainingPair",
]
