"""The ACS optimizer: unknowns, settings, solvers, and one steppable object."""

from .frame import FrameOptimizer as FrameOptimizer
from .frame import Iterate as Iterate
from .frame import Progress as Progress
from .settings import FreeParameters as FreeParameters
from .settings import OptimizerSettings as OptimizerSettings

__all__ = ["FrameOptimizer", "FreeParameters", "Iterate", "OptimizerSettings", "Progress"]
