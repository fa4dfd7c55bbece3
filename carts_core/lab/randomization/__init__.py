"""Training images for the networks, generated on the fly with domain randomization."""

from ...settings import AppearanceRanges as AppearanceRanges
from ...settings import ImageSettings as ImageSettings
from .samples import BACKGROUND as BACKGROUND
from .samples import HEAD as HEAD
from .samples import SHAFT as SHAFT
from .samples import SURFACE_UNIT as SURFACE_UNIT
from .samples import PairGenerator as PairGenerator
from .samples import SurfaceGenerator as SurfaceGenerator
from .samples import SurfaceSample as SurfaceSample
from .samples import TrainingPair as TrainingPair
