"""Solvers: unknowns, factors, stages and step-wise optimizers. Names that require PyTorch are imported on first use."""

from typing import TYPE_CHECKING

from ..package_imports import names_on_first_use
from ..settings import CALIBRATION as CALIBRATION
from ..settings import CALIBRATION_SETTINGS as CALIBRATION_SETTINGS
from ..settings import DescentSolver as DescentSolver
from ..settings import FreeParameters as FreeParameters
from ..settings import SequenceSettings as SequenceSettings
from ..settings import SolverSettings as SolverSettings
from ..settings import SurfaceSolver as SurfaceSolver
from .given_masks import GivenMasks as GivenMasks
from .results import BASE_FRAME_GAIN as BASE_FRAME_GAIN
from .results import Iterate as Iterate
from .results import Progress as Progress
from .results import StopReason as StopReason
from .results import Verdict as Verdict
from .results import fit_words as fit_words
from .results import joint_words as joint_words
from .results import undetermined_joints as undetermined_joints

if TYPE_CHECKING:
    from .calibration import CalibrationIterate as CalibrationIterate
    from .calibration import CalibrationOptimizer as CalibrationOptimizer
    from .calibration import CalibrationResult as CalibrationResult
    from .calibration import UnknownChange as UnknownChange
    from .factors import Factor as Factor
    from .factors import Linearization as Linearization
    from .frame import FrameOptimizer as FrameOptimizer
    from .frame_problem import propose_ignore as propose_ignore
    from .observation import Backgrounds as Backgrounds
    from .predictor import FramePredictor as FramePredictor
    from .predictor import ImagePredictor as ImagePredictor
    from .predictor import MaskPredictor as MaskPredictor
    from .predictor import NetworkPredictor as NetworkPredictor
    from .predictor import SurfacePredictor as SurfacePredictor
    from .refinement import MaskRefiner as MaskRefiner
    from .sequence import SequenceOptimizer as SequenceOptimizer
    from .sequence_frame import FrameEstimate as FrameEstimate
    from .sequence_frame import Origin as Origin
    from .sequence_frame import sequence_checkpoint as sequence_checkpoint
    from .verdict import Assessment as Assessment
    from .verdict import DomainCheck as DomainCheck
    from .verdict import Evidence as Evidence
    from .verdict import SequenceAssessment as SequenceAssessment
    from .verdict import check_domain as check_domain

__getattr__, __dir__ = names_on_first_use(
    __name__,
    {
        "calibration": ("CalibrationIterate", "CalibrationOptimizer", "CalibrationResult", "UnknownChange"),
        "factors": ("Factor", "Linearization"),
        "frame": ("FrameOptimizer",),
        "frame_problem": ("propose_ignore",),
        "observation": ("Backgrounds",),
        "predictor": ("FramePredictor", "ImagePredictor", "MaskPredictor", "NetworkPredictor", "SurfacePredictor"),
        "refinement": ("MaskRefiner",),
        "sequence": ("SequenceOptimizer",),
        "sequence_frame": ("FrameEstimate", "Origin", "sequence_checkpoint"),
        "verdict": ("Assessment", "DomainCheck", "Evidence", "SequenceAssessment", "check_domain"),
    },
)
