"""What people can set, in plain dataclasses that check their ranges.

Nothing here imports torch or what needs it, so that the command line knows its options at once.
"""

from .appearance import DARKEST_BRIGHTNESS as DARKEST_BRIGHTNESS
from .appearance import AppearanceRanges as AppearanceRanges
from .calibration import CALIBRATION as CALIBRATION
from .calibration import CALIBRATION_SETTINGS as CALIBRATION_SETTINGS
from .export import FormatName as FormatName
from .export import Images as Images
from .export import Parts as Parts
from .loss_weights import ObjectiveWeights as ObjectiveWeights
from .loss_weights import SurfaceWeights as SurfaceWeights
from .network import Architecture as Architecture
from .optimization import DescentSolver as DescentSolver
from .optimization import FreeParameters as FreeParameters
from .optimization import Loss as Loss
from .optimization import SolverName as SolverName
from .optimization import SolverSettings as SolverSettings
from .optimization import SurfaceSolver as SurfaceSolver
from .optimization import solver as solver
from .optimization import surface_solver as surface_solver
from .sequence import Direction as Direction
from .sequence import SequenceSettings as SequenceSettings
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
from .synthesis import DOMAINS as DOMAINS
from .synthesis import DomainConfig as DomainConfig
from .synthesis import EndoscopeConfig as EndoscopeConfig
from .synthesis import MeasurementError as MeasurementError
from .synthesis import MotionConfig as MotionConfig
from .synthesis import RenderConfig as RenderConfig
from .synthesis import SensorConfig as SensorConfig
from .synthesis import SynthesisConfig as SynthesisConfig
from .training import NetworkName as NetworkName
from .training import TrainingConfig as TrainingConfig
from .training_images import ImageSettings as ImageSettings
