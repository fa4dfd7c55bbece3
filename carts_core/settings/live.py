"""How a live stream is tracked."""

from dataclasses import dataclass

from . import presets
from .checks import require
from .stages import Stage


@dataclass(frozen=True)
class LiveSettings:
    """What a tracker does with each frame, and when it takes the arms for lost."""

    small: tuple[Stage, ...] = presets.WARM
    """Stages of a frame that is where it is expected."""
    full: tuple[Stage, ...] = presets.WARM_WIDE
    """Stages where the small ones end in a bad fit."""
    search: tuple[Stage, ...] = presets.LIVE_SEARCH
    """Stages where the arms are lost; `small` follows."""
    bad_loss: float = 0.06
    """Loss from which a fit is bad [1]."""
    bad_factor: float = 2.5
    """A fit of that many times the usual loss is bad, too [1]."""
    lost_seconds: float = 0.25
    """After bad fits for so long, the arms are lost [s]."""
    search_seconds: float = 0.4
    """Lost arms are searched for this often; frames between are compared with where they were last seen [s]."""
    oldest_seconds: float = 0.1
    """A frame whose result would be older, at the usual time for a frame, is dropped for the next one [s]."""

    def __post_init__(self) -> None:
        require(1e-3 <= self.bad_loss <= 10, "bad_loss", self.bad_loss, "0.001 to 10")
        require(1 <= self.bad_factor <= 100, "bad_factor", self.bad_factor, "1 to 100")
        for name in ("lost_seconds", "search_seconds", "oldest_seconds"):
            require(0 <= getattr(self, name) <= 3600, name, getattr(self, name), "0 to 3600 s")
