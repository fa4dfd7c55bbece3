"""The ACS optimizer: unknowns, settings, solvers, and one steppable object."""

from .frame import FrameOptimizer as FrameOptimizer
from .frame import Iterate as Iterate
from .frame import Progress as Progress
from .sequence import FrameEstimate as FrameEstimate
from .sequence import SequenceOptimizer as SequenceOptimizer
from .sequence_settings import SequenceSettings as SequenceSettings
from .settings import FreeParameters as FreeParameters
from .settings import OptimizerSettings as OptimizerSettings

__all__ = [
    "FrameEstimate",
    "FrameOptimizer",
    "FreeParameters",
    "Iterate",
    "OptimizerSettings",
    "Progress",
    "SequenceOptimizer",
    "SequenceSettings",
]
