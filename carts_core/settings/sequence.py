"""How the error of measured kinematics is expected to behave over a sequence."""

from dataclasses import dataclass
from typing import Literal, get_args

from ..errors import SettingsError

Direction = Literal["forward", "backward"]
"""In which direction corrections are handed on from frame to frame."""


@dataclass(frozen=True)
class SequenceSettings:
    """Model of the measurement error and the way through the frames; defaults are measured
    (docs/explanation/sequences.md)."""

    constant_deg: float = 2.0
    """Deviation of the constant part of the error [deg]; `lever` turns it into metres."""
    drift_deg: float = 0.2
    """Deviation of the slow drift about it [deg]."""
    drift_seconds: float = 4.0
    """Time after which the drift has forgotten all but 1/e of itself [s]."""
    jitter_deg: float = 0.05
    """Deviation of the error that is new in every frame [deg]."""
    sight_noise: float = 4.0
    """As `noise`, for what a frame tells; larger, since the errors of neighbouring pixels are alike [1]."""
    image_seconds: float = 0.5
    """Time after which errors of images are no longer alike (a correlation of 1/e); frames that follow each other
    faster tell the others less [s]."""
    opinions: int = 5
    """How many frames, evenly spread, are looked at alone before the first one, which starts where suits all of them
    best; 1 asks the first frame only [1]."""
    cold_factor: float = 2.0
    """A loss of that many times the usual one has a frame start cold [1]."""
    direction: Direction = "forward"
    """Where the first pass begins: at the first frame, or at the last one."""
    frame_seconds: float = 0.25
    """Time between frames, where the sequence does not tell; images without times are mostly a few per second [s]."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise SettingsError(f"{name} is {value!r}; allowed is {low:g} to {high:g}. Leave it at its default.")
        if self.direction not in get_args(Direction):
            raise SettingsError(f"direction is {self.direction!r}; allowed is {' or '.join(get_args(Direction))}.")


_RANGES = {
    "constant_deg": (1e-3, 360.0),
    "drift_deg": (1e-3, 360.0),
    "drift_seconds": (1e-3, 1e6),
    "jitter_deg": (1e-3, 360.0),
    "sight_noise": (1e-3, 100.0),
    "image_seconds": (1e-6, 1e6),
    "opinions": (1, 20),
    "cold_factor": (1.0, 100.0),
    "frame_seconds": (1e-6, 1e6),
}
