"""Settings of a synthetic sequence. Everything random follows from `SynthesisConfig.seed`."""

import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import SettingsError
from ..resources import shipped_robot

DOMAINS = ("regular", "low_brightness", "bleeding", "smoke", "background_change", "simulated_smoke")
"""The counterfactual domains: the same motion under different conditions."""


def _require(owner: object, name: str, low: float, high: float) -> None:
    value = getattr(owner, name)
    if not low <= value <= high:
        raise SettingsError(f"{type(owner).__name__}.{name} is {value}; it must lie between {low:g} and {high:g}.")


@dataclass(frozen=True)
class EndoscopeConfig:
    """The camera and where it stands above the tissue."""

    width: int = 640
    """Image width [px]."""
    height: int = 480
    """Image height [px]."""
    focal_length: float = 560.0
    """Focal length for an image 640 px wide [px]; other widths scale it."""
    distance: float = 0.100
    """From the camera to the middle of the scene [m]; at most 0.3 for instruments."""
    elevation: float = 1.05
    """Angle between the viewing direction and the tissue's plane [rad]."""
    stereo: bool = False
    """Render a right camera too."""
    baseline: float = 0.005
    """Distance between the left and the right camera [m]."""

    def __post_init__(self) -> None:
        _require(self, "width", 32, 4096)
        _require(self, "height", 32, 4096)
        _require(self, "focal_length", 100, 5000)
        _require(self, "distance", 0.05, 10.0)
        _require(self, "elevation", 0.5, 1.57)
        _require(self, "baseline", 0.0, 1.0)


@dataclass(frozen=True)
class MotionConfig:
    """How the two instruments move."""

    frames: int = 24
    """Number of frames."""
    frame_rate: float = 4.0
    """Frames per second [1/s]."""
    control_interval: float = 1.5
    """Time between the random control points of the splines [s]."""
    reach: tuple[float, float, float] = (0.016, 0.012, 0.009)
    """Half size of the box in which each tool tip moves: right, away from the viewer, up [m]."""
    wrist_range: float = 0.35
    """Largest deviation of roll and wrist joints from their middle [rad]."""
    jaw_range: tuple[float, float] = (0.0, 0.9)
    """Smallest and largest jaw angle [rad]."""
    clearance: float = 0.0015
    """Smallest distance kept between the instruments, and between instrument and tissue [m]."""

    def __post_init__(self) -> None:
        _require(self, "frames", 1, 100_000)
        _require(self, "frame_rate", 0.1, 240)
        _require(self, "control_interval", 0.1, 60)
        _require(self, "wrist_range", 0.0, 1.0)
        if not all(0.0 <= half <= 0.1 for half in self.reach):
            raise SettingsError(f"MotionConfig.reach is {self.reach}; each value must lie between 0 and 0.1.")
        if not 0.0 <= self.jaw_range[0] <= self.jaw_range[1] <= 1.3:
            raise SettingsError(f"MotionConfig.jaw_range is {self.jaw_range}; give 0 <= smallest <= largest <= 1.3.")
        _require(self, "clearance", 0.0, 0.02)


@dataclass(frozen=True)
class MeasurementError:
    """measured = true + bias + drift(t) + noise(t), for every joint; [rad] for revolute joints, [m] for insertion."""

    bias: tuple[float, ...] = (0.020, 0.020, 0.0012, 0.035, 0.035, 0.035, 0.035)
    """Size of the constant offset; each joint draws its sign and a factor from 0.6 to 1.2."""
    drift: tuple[float, ...] = (0.004, 0.004, 0.0003, 0.008, 0.008, 0.008, 0.008)
    """Amplitude of the slow wandering about that offset."""
    drift_period: float = 20.0
    """Typical period of the wandering [s]."""
    noise: tuple[float, ...] = (0.0004, 0.0004, 0.00004, 0.001, 0.001, 0.001, 0.001)
    """Standard deviation of the noise that is new in every frame."""

    def __post_init__(self) -> None:
        _require(self, "drift_period", 0.1, 1e6)
        if not len(self.bias) == len(self.drift) == len(self.noise):
            raise SettingsError(
                f"MeasurementError: bias, drift and noise have {len(self.bias)}, {len(self.drift)} and "
                f"{len(self.noise)} values; give one per joint in each."
            )


@dataclass(frozen=True)
class RenderConfig:
    """Path tracing."""

    samples: int = 8
    """Paths per pixel; noise falls with the square root."""
    bounces: int = 3
    """Longest path, counted in segments; 2 has no light between tissue and metal."""
    robot_faces: int = 40_000
    """Triangles per robot, more than the optimizer's renderer uses."""
    tissue_resolution: int = 520
    """Grid points of the tissue's height field along each side."""

    texture_resolution: int = 1536
    """Texels of the tissue's colour along each side."""

    def __post_init__(self) -> None:
        _require(self, "texture_resolution", 64, 8192)
        _require(self, "samples", 1, 4096)
        _require(self, "bounces", 2, 16)
        _require(self, "robot_faces", 500, 1_000_000)
        _require(self, "tissue_resolution", 32, 2048)


@dataclass(frozen=True)
class SensorConfig:
    """From radiance to the bytes of a picture."""

    exposure: float = 0.18
    """Where the median radiance of the first frame comes to lie, as a fraction of white."""
    vignette: float = 0.45
    """Light lost in the corners, as a fraction."""
    blur: float = 0.65
    """Standard deviation of the lens blur for an image 640 px wide [px]."""
    shutter: float = 1 / 80
    """Exposure time, for motion blur [s]."""
    full_well: float = 6000.0
    """Electrons at white: shot noise is sqrt(signal x full_well) electrons."""
    read_noise: float = 12.0
    """Standard deviation of the read noise [electrons]."""
    sharpening: float = 0.2
    """Gain of the edge enhancement that endoscope processors apply."""
    jpeg_quality: int = 85
    """Quality of the JPEG files."""

    def __post_init__(self) -> None:
        _require(self, "exposure", 0.01, 1.0)
        _require(self, "vignette", 0.0, 1.0)
        _require(self, "blur", 0.0, 10.0)
        _require(self, "shutter", 0.0, 1.0)
        _require(self, "full_well", 10.0, 1e6)
        _require(self, "read_noise", 0.0, 1e3)
        _require(self, "sharpening", 0.0, 2.0)
        _require(self, "jpeg_quality", 1, 100)


@dataclass(frozen=True)
class DomainConfig:
    """Strengths of the counterfactual conditions."""

    low_brightness: float = 0.22
    """Light of the low brightness domain relative to the regular one."""
    blood_coverage: float = 0.40
    """Part of the tissue under blood."""
    blood_on_tools: float = 0.30
    """Part of the instruments' surface with a film or drops of blood."""
    smoke_density: float = 8.0
    """Mean extinction of the smoke [1/m]; at 8 and 0.1 m of depth, 55 % of the light is lost."""
    smoke_wavelength: float = 0.042
    """Size of the largest eddies [m]."""
    smoke_speed: float = 0.02
    """Speed with which the smoke drifts [m/s]."""
    overlay_opacity: float = 0.50
    """Mean opacity of the two-dimensional overlay of the simulated smoke domain."""

    def __post_init__(self) -> None:
        _require(self, "low_brightness", 0.0, 1.0)
        _require(self, "blood_coverage", 0.0, 1.0)
        _require(self, "blood_on_tools", 0.0, 1.0)
        _require(self, "smoke_density", 0.0, 200.0)
        _require(self, "smoke_wavelength", 0.002, 1.0)
        _require(self, "smoke_speed", 0.0, 1.0)
        _require(self, "overlay_opacity", 0.0, 1.0)


@dataclass(frozen=True)
class SynthesisConfig:
    """A synthetic sequence of two arms."""

    seed: int = 7
    """Decides everything random: tissue, motion, errors, noise."""
    name: str = "synthetic"
    """Name of the sequence."""
    robot: Path = field(default_factory=shipped_robot)
    """URDF, or `builtin:NAME`. One with the joints of a PSM makes both arms, any other one a single arm."""
    tip_link: str = "tool_tip_link"
    """Link of the URDF whose origin is the point between the jaws' tips; of another robot the last link with a mesh."""
    domains: tuple[str, ...] = DOMAINS
    """The conditions to render."""
    endoscope: EndoscopeConfig = EndoscopeConfig()
    """Camera."""
    motion: MotionConfig = MotionConfig()
    """Motion."""
    error: MeasurementError = MeasurementError()
    """What the encoders get wrong."""
    render: RenderConfig = RenderConfig()
    """Path tracing."""
    sensor: SensorConfig = SensorConfig()
    """Image sensor."""
    domain: DomainConfig = DomainConfig()
    """Strengths of the conditions."""

    def __post_init__(self) -> None:
        _require(self, "seed", 0, 2**32 - 1)
        unknown = [name for name in self.domains if name not in DOMAINS]
        if unknown or not self.domains:
            raise SettingsError(
                f"SynthesisConfig.domains is {self.domains}; name at least one of: {', '.join(DOMAINS)}."
            )

    def rng(self, *purpose: str | int) -> np.random.Generator:
        """A generator of its own for each purpose, so that changing one thing leaves the others as they were."""
        words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in purpose]
        return np.random.default_rng([self.seed, *words])
