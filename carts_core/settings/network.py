"""What distinguishes one network from another."""

import json
from dataclasses import asdict, dataclass

from ..errors import SettingsError


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
    """Take the local mean off an image first, and not that of the whole image: a smooth veil then changes less."""
    local_contrast: float = 0.0
    """How much an image is divided by its local contrast instead of that of the whole image, from 0 (not at all) to 1
    (entirely); needs `local_mean`. What takes contrast from a part of an image then changes less."""

    def __post_init__(self) -> None:
        levels = len(self.widths)
        if levels < 2 or any(width < 1 for width in self.widths):
            raise SettingsError(f"widths are {self.widths}; give at least two positive channel counts.")
        if len(self.encoder_convolutions) != levels or any(n < 1 for n in self.encoder_convolutions):
            raise SettingsError(
                f"encoder_convolutions are {self.encoder_convolutions}; give {levels} counts of 1 or more."
            )
        if len(self.decoder_convolutions) != levels - 1 or any(n < 1 for n in self.decoder_convolutions):
            raise SettingsError(
                f"decoder_convolutions are {self.decoder_convolutions}; give {levels - 1} counts of 1 or more."
            )
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
        values = json.loads(text)
        local_mean, local_contrast = bool(values.pop("local_mean")), float(values.pop("local_contrast", 0.0))
        return Architecture(
            **{name: tuple(int(n) for n in counts) for name, counts in values.items()},
            local_mean=local_mean,
            local_contrast=local_contrast,
        )
