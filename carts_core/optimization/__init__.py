"""Solvers: unknowns, factors, stages, and the objects that can be stepped."""

from ..settings import CALIBRATION as CALIBRATION
from ..settings import CALIBRATION_SETTINGS as CALIBRATION_SETTINGS
from ..settings import DescentSolver as DescentSolver
from ..settings import FreeParameters as FreeParameters
from ..settings import SequenceSettings as SequenceSettings
from ..settings import SolverSettings as SolverSettings
from ..settings import SurfaceSolver as SurfaceSolver
from .base_frame_gain import BASE_FRAME_GAIN as BASE_FRAME_GAIN
from .calibration import CalibrationIterate as CalibrationIterate
from .calibration import CalibrationOptimizer as CalibrationOptimizer
from .calibration import CalibrationResult as CalibrationResult
from .calibration import UnknownChange as UnknownChange
from .counterfactual import Backgrounds as Backgrounds
from .evidence import Evidence as Evidence
from .factors import Factor as Factor
from .factors import Linearization as Linearization
from .familiarity import Familiarity as Familiarity
from .familiarity import familiarity as familiarity
from .fit import StopReason as StopReason
from .frame import FrameOptimizer as FrameOptimizer
from .frame import Iterate as Iterate
from .frame import Progress as Progress
from .ignore import propose_ignore as propose_ignore
from .masks import GivenMasks as GivenMasks
from .masks import MaskPredictor as MaskPredictor
from .observability import fit_words as fit_words
from .observability import undetermined_joints as undetermined_joints
from .predictor import FramePredictor as FramePredictor
from .predictor import ImagePredictor as ImagePredictor
from .predictor import NetworkPredictor as NetworkPredictor
from .predictor import SurfacePredictor as SurfacePredictor
from .resumable import sequence_checkpoint as sequence_checkpoint
from .sequence import SequenceOptimizer as SequenceOptimizer
from .sequence_estimate import FrameEstimate as FrameEstimate
from .sequence_estimate import Origin as Origin
from .verdict import Assessment as Assessment
from .verdict import Verdict as Verdict
from .verdict_of_many import SequenceAssessment as SequenceAssessment

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
    "Evidence",
    "Factor",
    "Familiarity",
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
    "familiarity",
    "fit_words",
    "propose_ignore",
    "undetermined_joints",
]
