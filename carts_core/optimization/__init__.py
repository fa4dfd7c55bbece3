"""Solvers: unknowns, factors, stages, and the objects that can be stepped."""

from ..settings import CALIBRATION as CALIBRATION
from ..settings import CALIBRATION_SETTINGS as CALIBRATION_SETTINGS
from ..settings import DescentSolver as DescentSolver
from ..settings import FreeParameters as FreeParameters
from ..settings import SequenceSettings as SequenceSettings
from ..settings import SolverSettings as SolverSettings
from ..settings import SurfaceSolver as SurfaceSolver
from .calibration import CalibrationIterate as CalibrationIterate
from .calibration import CalibrationOptimizer as CalibrationOptimizer
from .calibration import CalibrationResult as CalibrationResult
from .calibration import UnknownChange as UnknownChange
from .counterfactual import Backgrounds as Backgrounds
from .evidence import Evidence as Evidence
from .factors import Factor as Factor
from .factors import Linearization as Linearization
from .frame import BASE_FRAME_GAIN as BASE_FRAME_GAIN
from .frame import FrameOptimizer as FrameOptimizer
from .frame import Iterate as Iterate
from .frame import Progress as Progress
from .frame_problem import propose_ignore as propose_ignore
from .measurement import sequence_checkpoint as sequence_checkpoint
from .observability import fit_words as fit_words
from .observability import undetermined_joints as undetermined_joints
from .predictor import FramePredictor as FramePredictor
from .predictor import GivenMasks as GivenMasks
from .predictor import ImagePredictor as ImagePredictor
from .predictor import MaskPredictor as MaskPredictor
from .predictor import NetworkPredictor as NetworkPredictor
from .predictor import SurfacePredictor as SurfacePredictor
from .sequence import SequenceOptimizer as SequenceOptimizer
from .sequence_estimate import FrameEstimate as FrameEstimate
from .sequence_estimate import Origin as Origin
from .stages import StopReason as StopReason
from .verdict import Assessment as Assessment
from .verdict import DomainCheck as DomainCheck
from .verdict import SequenceAssessment as SequenceAssessment
from .verdict import Verdict as Verdict
from .verdict import check_domain as check_domain

__all__ = [
    "BASE_FRAME_GAIN",
    "CALIBRATION",
    "CALIBRATION_SETTINGS",
    "Assessment",
    "Backgrounds",
    "CalibrationIterate",
    "CalibrationOptimizer",
    "CalibrationResult",
    "DescentSolver",
    "DomainCheck",
    "Evidence",
    "Factor",
    "FrameEstimate",
    "FrameOptimizer",
    "FramePredictor",
    "FreeParameters",
    "GivenMasks",
    "ImagePredictor",
    "Iterate",
    "Linearization",
    "MaskPredictor",
    "NetworkPredictor",
    "Origin",
    "Progress",
    "SequenceAssessment",
    "SequenceOptimizer",
    "SequenceSettings",
    "SolverSettings",
    "StopReason",
    "SurfacePredictor",
    "SurfaceSolver",
    "UnknownChange",
    "Verdict",
    "check_domain",
    "fit_words",
    "propose_ignore",
    "undetermined_joints",
]
