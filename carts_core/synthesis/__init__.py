"""Synthetic sequences: motion, measurement error, path-traced images and the counterfactual domains."""

from .config import DOMAINS as DOMAINS
from .config import DomainConfig as DomainConfig
from .config import EndoscopeConfig as EndoscopeConfig
from .config import MeasurementError as MeasurementError
from .config import MotionConfig as MotionConfig
from .config import RenderConfig as RenderConfig
from .config import SensorConfig as SensorConfig
from .config import SynthesisConfig as SynthesisConfig
from .progress import progress_bar as progress_bar
from .synthesize import Progress as Progress
from .synthesize import synthesize as synthesize
