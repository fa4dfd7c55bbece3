"""The ACS optimizer: unknowns, settings, solvers, and one steppable object."""

from ..settings import CALIBRATION as CALIBRATION
from ..settings import CALIBRATION_SETTINGS as CALIBRATION_SETTINGS
from ..settings import FreeParameters as FreeParameters
from ..settings import OptimizerSettings as OptimizerSettings
from ..settings import SequenceSettings as SequenceSettings
from .calibration import CalibrationIterate as CalibrationIterate
from .calibration import CalibrationOptimizer as CalibrationOptimizer
from .calibration import CalibrationResult as CalibrationResult
from .calibration import UnknownChange as UnknownChange
from .counterfactual import Backgrounds as Backgrounds
from .frame import BASE_FRAME_GAIN as BASE_FRAME_GAIN
from .frame import FrameOptimizer as FrameOptimizer
from .frame import Iterate as Iterate
from .frame import Progress as Progress
from .ignore import propose_ignore as propose_ignore
from .recalled import sequence_checkpoint as sequence_checkpoint
from .sequence import FrameEstimate as FrameEstimate
from .sequence import SequenceOptimizer as SequenceOptimizer

__all__ = [
    "BASE_FRAME_GAIN",
    "CALIBRATION",
    "CALIBRATION_SETTINGS",
    "Backgrounds",
    "CalibrationIterate",
    "CalibrationOptimizer",
    "CalibrationResult",
    "FrameEstimate",
    "FrameOptimizer",
    "FreeParameters",
    "Iterate",
    "OptimizerSettings",
    "Progress",
    "SequenceOptimizer",
    "SequenceSettings",
    "UnknownChange",
    "propose_ignore",
]
