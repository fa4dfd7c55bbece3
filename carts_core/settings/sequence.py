"""How the error of measured kinematics is expected to behave over a sequence."""

from dataclasses import dataclass
from typing import Literal, get_args

from . import presets
from .checks import require
from .stages import Stage

Direction = Literal["forward", "backward"]
"""In which direction corrections are handed on from frame to frame."""


@dataclass(frozen=True)
class SequenceSettings:
    """Model of the measurement error, and how frames inform each other (docs: explanation/sequences)."""

    constant_deg: float = 2.0
    """Deviation of the constant part of the error [deg]; `length_scale` turns it into metres."""
    drift_deg: float = 0.2
    """Deviation of the slow drift about it [deg]."""
    drift_seconds: float = 4.0
    """Time constant of the drift's autocorrelation [s]."""
    jitter_deg: float = 0.05
    """Deviation of the error that is independent in every frame [deg]."""
    measurement_noise: float = 4.0
    """As `SurfaceSolver.noise`, for a frame's measurement in the smoother; larger, since the errors of neighbouring
    pixels are correlated [1]."""
    correlation_seconds: float = 0.5
    """Time constant of the autocorrelation of image errors; frames that follow each other faster count less for the
    others [s]."""
    shared_seconds: float = 5.0
    """The same for the reported deviations: a network errs alike for as long as an instrument is seen from one side,
    and deviations are not to count on more than that [s]."""
    initial_frames: int = 5
    """How many frames, evenly spread, are solved alone to find where the first one starts; 1 takes the first frame
    only [1]."""
    cold_factor: float = 2.0
    """A loss of that many times the median has a frame start cold [1]."""
    direction: Direction = "forward"
    """Where the first pass begins: at the first frame, or at the last one."""
    frame_seconds: float = 0.25
    """Time between frames, where the sequence has no times [s]."""
    cold: tuple[Stage, ...] = presets.COLD
    """Stages from measured kinematics; `warm` follows."""
    warm: tuple[Stage, ...] = presets.WARM
    """Stages from the correction that the other frames predict."""
    wide: tuple[Stage, ...] = presets.WARM_WIDE
    """Stages where `warm` ends with an unusual loss, before a cold start."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            require(low <= getattr(self, name) <= high, name, getattr(self, name), f"{low:g} to {high:g}")
        require(self.direction in get_args(Direction), "direction", self.direction, " or ".join(get_args(Direction)))


_RANGES = {
    "constant_deg": (1e-3, 360.0),
    "drift_deg": (1e-3, 360.0),
    "drift_seconds": (1e-3, 1e6),
    "jitter_deg": (1e-3, 360.0),
    "measurement_noise": (1e-3, 100.0),
    "correlation_seconds": (1e-6, 1e6),
    "shared_seconds": (1e-6, 1e6),
    "initial_frames": (1, 20),
    "cold_factor": (1.0, 100.0),
    "frame_seconds": (1e-6, 1e6),
}
