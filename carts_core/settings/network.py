"""What distinguishes one network from another."""

import json
from dataclasses import asdict, dataclass

from ..errors import SettingsError
from ..files.reading import parse_json

_MOST_LEVELS, _MOST_CHANNELS, _MOST_CONVOLUTIONS = 8, 1024, 16


@dataclass(frozen=True)
class Architecture:
    """What distinguishes one feature network from another; it travels in the weights file."""

    widths: tuple[int, ...] = (12, 24, 48, 64, 96)
    """Channels per level, from full resolution down; each level halves the resolution."""
    encoder_convolutions: tuple[int, ...] = (1, 2, 2, 2, 2)
    """3x3 convolutions per level on the way down. Full resolution costs most, so it has one."""
    decoder_convolutions: tuple[int, ...] = (1, 1, 1, 1)
    """3x3 convolutions per level on the way up, from full resolution down."""
    local_mean: bool = True
    """Take the local mean off an image first, and not that of the whole image: smooth haze then changes less."""
    local_contrast: float = 0.0
    """How much an image is divided by its local contrast instead of that of the whole image, from 0 (not at all) to 1
    (entirely); needs `local_mean`. What takes contrast from a part of an image then changes less."""

    def __post_init__(self) -> None:
        levels = len(self.widths)
        if not 2 <= levels <= _MOST_LEVELS or any(not 1 <= width <= _MOST_CHANNELS for width in self.widths):
            raise SettingsError(
                f"widths are {self.widths}; give 2 to {_MOST_LEVELS} channel counts of 1 to {_MOST_CHANNELS}."
            )
        for name, count in (("encoder_convolutions", levels), ("decoder_convolutions", levels - 1)):
            values = getattr(self, name)
            if len(values) != count or any(not 1 <= n <= _MOST_CONVOLUTIONS for n in values):
                raise SettingsError(f"{name} are {values}; give {count} counts of 1 to {_MOST_CONVOLUTIONS}.")
        if not 0 <= self.local_contrast <= float(self.local_mean):
            raise SettingsError(
                f"local_contrast is {self.local_contrast}; give 0 to 1, and 0 without local_mean, which is "
                f"{self.local_mean}."
            )

    @property
    def stride(self) -> int:
        """Width and height of an input must be multiples of this [px]."""
        return 2 ** (len(self.widths) - 1)

    def to_json(self) -> str:
        """One line of JSON; the inverse of `from_json`."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> "Architecture":
        """Read what `to_json` wrote.

        Raises:
            ValueError, TypeError, KeyError, AttributeError: the text is not an architecture.
            SettingsError: it is one that cannot exist.
        """
        values = parse_json(text)
        local_mean, local_contrast = bool(values.pop("local_mean")), float(values.pop("local_contrast", 0.0))
        return Architecture(
            **{name: tuple(int(n) for n in counts) for name, counts in values.items()},
            local_mean=local_mean,
            local_contrast=local_contrast,
        )
