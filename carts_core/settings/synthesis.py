"""Settings of a synthetic sequence. All random choices are determined by `SynthesisConfig.seed`."""

import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from ..errors import SettingsError
from ..resources import shipped_robot
from .ranges import Range, Ranged, Share

DOMAINS = ("regular", "low_brightness", "bleeding", "smoke", "background_change", "simulated_smoke")
"""Counterfactual domains: the same motion under different conditions."""


@dataclass(frozen=True)
class EndoscopeConfig(Ranged):
    """Endoscope camera, and its pose above the tissue."""

    width: Annotated[int, Range(32, 4096)] = 640
    """Image width [px]."""
    height: Annotated[int, Range(32, 4096)] = 480
    """Image height [px]."""
    focal_length: Annotated[float, Range(100, 5000)] = 560.0
    """Focal length for an image 640 px wide [px]; scaled for other widths."""
    distance: Annotated[float, Range(0.05, 10.0)] = 0.100
    """Distance from the camera to the centre of the scene [m]; at most 0.16 for instruments."""
    elevation: Annotated[float, Range(0.5, 1.57)] = 1.05
    """Angle between the viewing direction and the tissue plane [rad]."""
    stereo: bool = False
    """Also render a right camera."""
    baseline: Share = 0.005
    """Distance between the left and the right camera [m]."""


@dataclass(frozen=True)
class MotionConfig(Ranged):
    """Motion of the instruments."""

    frames: Annotated[int, Range(1, 100_000)] = 24
    """Number of frames."""
    frame_rate: Annotated[float, Range(0.1, 240)] = 4.0
    """Frames per second [1/s]."""
    control_interval: Annotated[float, Range(0.1, 60)] = 1.5
    """Time between the random control points of the splines [s]."""
    reach: Annotated[tuple[float, float, float], Range(0, 0.1, "m")] = (0.016, 0.012, 0.009)
    """Half size of the box in which each tool tip moves: right, away from the viewer, up [m]."""
    wrist_range: Share = 0.35
    """Maximum deviation of roll and wrist joints from their central position [rad]."""
    jaw_range: tuple[float, float] = (0.0, 0.9)
    """Minimum and maximum jaw angle [rad]."""
    clearance: Annotated[float, Range(0.0, 0.02)] = 0.0015
    """Minimum distance between the instruments, and between instrument and tissue [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.jaw_range[0] <= self.jaw_range[1] <= 1.3:
            raise SettingsError(f"MotionConfig.jaw_range is {self.jaw_range}; give 0 <= smallest <= largest <= 1.3.")


@dataclass(frozen=True)
class MeasurementError(Ranged):
    """Measurement error model per joint: measured = true + bias + drift(t) + noise(t); [rad] for revolute joints, [m]
    for insertion."""

    bias: tuple[float, ...] = (0.020, 0.020, 0.0012, 0.035, 0.035, 0.035, 0.035)
    """Magnitude of the constant offset; its sign and a factor from 0.6 to 1.2 are drawn for each joint."""
    drift: tuple[float, ...] = (0.004, 0.004, 0.0003, 0.008, 0.008, 0.008, 0.008)
    """Amplitude of the slow drift about the offset."""
    drift_period: Annotated[float, Range(0.1, 1e6)] = 20.0
    """Typical period of the drift [s]."""
    noise: tuple[float, ...] = (0.0004, 0.0004, 0.00004, 0.001, 0.001, 0.001, 0.001)
    """Standard deviation of the noise, independent in every frame."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.bias) == len(self.drift) == len(self.noise):
            raise SettingsError(
                f"MeasurementError: bias, drift and noise have {len(self.bias)}, {len(self.drift)} and "
                f"{len(self.noise)} values; give one per joint in each."
            )


@dataclass(frozen=True)
class RenderConfig(Ranged):
    """Settings of the path tracer."""

    samples: Annotated[int, Range(1, 4096)] = 8
    """Paths per pixel; noise is inversely proportional to the square root of this number."""
    bounces: Annotated[int, Range(2, 16)] = 3
    """Maximum path length in segments; 2 excludes interreflections between tissue and metal."""
    robot_faces: Annotated[int, Range(500, 1_000_000)] = 40_000
    """Triangles per robot, more than the optimizer's renderer uses."""
    tissue_resolution: Annotated[int, Range(32, 2048)] = 520
    """Grid points of the tissue's height field along each side."""

    texture_resolution: Annotated[int, Range(64, 8192)] = 1536
    """Texels of the tissue's colour texture along each side."""


@dataclass(frozen=True)
class SensorConfig(Ranged):
    """Image sensor: conversion of radiance to pixel values."""

    exposure: Annotated[float, Range(0.01, 1.0)] = 0.18
    """Median radiance of the first frame as a fraction of white [1]."""
    vignette: Share = 0.45
    """Fraction of light lost in the corners."""
    blur: Annotated[float, Range(0.0, 10.0)] = 0.65
    """Standard deviation of the lens blur for an image 640 px wide [px]."""
    shutter: Share = 1 / 80
    """Exposure time, for motion blur [s]."""
    full_well: Annotated[float, Range(10.0, 1e6)] = 6000.0
    """Electrons at white: shot noise is sqrt(signal x full_well) electrons."""
    read_noise: Annotated[float, Range(0.0, 1e3)] = 12.0
    """Standard deviation of the read noise [electrons]."""
    sharpening: Annotated[float, Range(0.0, 2.0)] = 0.2
    """Gain of the edge enhancement that endoscope processors apply."""
    jpeg_quality: Annotated[int, Range(1, 100)] = 85
    """Quality of the JPEG files."""


@dataclass(frozen=True)
class DomainConfig(Ranged):
    """Strengths of the counterfactual conditions."""

    low_brightness: Share = 0.22
    """Light of the low brightness domain, relative to the regular domain."""
    blood_coverage: Share = 0.40
    """Fraction of the tissue covered with blood."""
    blood_on_tools: Share = 0.30
    """Fraction of the instruments' surface with a film or drops of blood."""
    smoke_density: Annotated[float, Range(0.0, 200.0)] = 8.0
    """Mean extinction of the smoke [1/m]; with 8, about 60 % of the light from a depth of 0.1 m is lost."""
    smoke_wavelength: Annotated[float, Range(0.002, 1.0)] = 0.042
    """Size of the largest eddies [m]."""
    smoke_speed: Share = 0.02
    """Drift speed of the smoke [m/s]."""
    overlay_opacity: Share = 0.50
    """Mean opacity of the two-dimensional overlay of the simulated smoke domain."""


@dataclass(frozen=True)
class SynthesisConfig(Ranged):
    """Synthetic sequence of two arms."""

    seed: Annotated[int, Range(0, 2**32 - 1)] = 7
    """Random seed of tissue, motion, errors and noise."""
    name: str = "synthetic"
    """Name of the sequence."""
    robot: Path = field(default_factory=shipped_robot)
    """URDF, or `builtin:NAME`. A robot with the joints of a PSM is used for two arms, other robots for a single arm."""
    tip_link: str = "tool_tip_link"
    """Link of the URDF whose origin is the point between the jaw tips; for robots other than the PSM, the default means
    the last link with a mesh."""
    domains: tuple[str, ...] = DOMAINS
    """Conditions to render."""
    endoscope: EndoscopeConfig = EndoscopeConfig()
    """Camera."""
    motion: MotionConfig = MotionConfig()
    """Motion."""
    error: MeasurementError = MeasurementError()
    """Measurement error of the encoders."""
    render: RenderConfig = RenderConfig()
    """Path tracing."""
    sensor: SensorConfig = SensorConfig()
    """Image sensor."""
    domain: DomainConfig = DomainConfig()
    """Strengths of the conditions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = [name for name in self.domains if name not in DOMAINS]
        if unknown or not self.domains:
            raise SettingsError(
                f"SynthesisConfig.domains is {self.domains}; give at least one of: {', '.join(DOMAINS)}."
            )

    def rng(self, *purpose: str | int) -> np.random.Generator:
        """Random generator for a purpose. Each purpose has its own generator, so that changes in one do not affect the
        others."""
        words = [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in purpose]
        return np.random.default_rng([self.seed, *words])
