"""Synthetic sequences: motion, measurement error, path-traced images and the counterfactual domains."""

from ...settings import DOMAINS as DOMAINS
from ...settings import DomainConfig as DomainConfig
from ...settings import EndoscopeConfig as EndoscopeConfig
from ...settings import MeasurementError as MeasurementError
from ...settings import MotionConfig as MotionConfig
from ...settings import RenderConfig as RenderConfig
from ...settings import SensorConfig as SensorConfig
from ...settings import SynthesisConfig as SynthesisConfig
from .synthesize import Progress as Progress
from .synthesize import synthesize as synthesize
