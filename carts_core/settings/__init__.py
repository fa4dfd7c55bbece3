"""Settings as dataclasses with range checks.

No module of this package imports torch, so that the command line starts quickly.
"""

from typing import TYPE_CHECKING

from ..package_imports import names_on_first_use
from .interchange import ANNOTATION_FORMATS as ANNOTATION_FORMATS
from .interchange import AnnotationFormat as AnnotationFormat
from .interchange import DrawnOn as DrawnOn
from .interchange import FormatName as FormatName
from .interchange import Images as Images
from .interchange import Masks as Masks
from .interchange import Parts as Parts
from .optimization import CALIBRATION as CALIBRATION
from .optimization import CALIBRATION_SETTINGS as CALIBRATION_SETTINGS
from .optimization import DescentSolver as DescentSolver
from .optimization import Direction as Direction
from .optimization import FreeParameters as FreeParameters
from .optimization import Loss as Loss
from .optimization import SequenceSettings as SequenceSettings
from .optimization import SolverName as SolverName
from .optimization import SolverSettings as SolverSettings
from .optimization import SurfaceSolver as SurfaceSolver
from .optimization import solver as solver
from .optimization import surface_solver as surface_solver
from .stages import AlignEdges as AlignEdges
from .stages import Descend as Descend
from .stages import Evaluate as Evaluate
from .stages import FirstOrder as FirstOrder
from .stages import Given as Given
from .stages import IgnoreOccluders as IgnoreOccluders
from .stages import Observe as Observe
from .stages import PreferStart as PreferStart
from .stages import RandomRestart as RandomRestart
from .stages import RejectFailed as RejectFailed
from .stages import Stage as Stage

if TYPE_CHECKING:
    from .synthesis import DOMAINS as DOMAINS
    from .synthesis import DomainConfig as DomainConfig
    from .synthesis import EndoscopeConfig as EndoscopeConfig
    from .synthesis import MeasurementError as MeasurementError
    from .synthesis import MotionConfig as MotionConfig
    from .synthesis import RenderConfig as RenderConfig
    from .synthesis import SensorConfig as SensorConfig
    from .synthesis import SynthesisConfig as SynthesisConfig
    from .training import DARKEST_BRIGHTNESS as DARKEST_BRIGHTNESS
    from .training import AppearanceRanges as AppearanceRanges
    from .training import Architecture as Architecture
    from .training import ImageSettings as ImageSettings
    from .training import NetworkName as NetworkName
    from .training import ObjectiveWeights as ObjectiveWeights
    from .training import SurfaceArchitecture as SurfaceArchitecture
    from .training import SurfaceWeights as SurfaceWeights
    from .training import TrainingConfig as TrainingConfig

__getattr__, __dir__ = names_on_first_use(
    __name__,
    {
        "synthesis": (
            "DOMAINS",
            "DomainConfig",
            "EndoscopeConfig",
            "MeasurementError",
            "MotionConfig",
            "RenderConfig",
            "SensorConfig",
            "SynthesisConfig",
        ),
        "training": (
            "DARKEST_BRIGHTNESS",
            "AppearanceRanges",
            "Architecture",
            "ImageSettings",
            "NetworkName",
            "ObjectiveWeights",
            "SurfaceArchitecture",
            "SurfaceWeights",
            "TrainingConfig",
        ),
    },
)
