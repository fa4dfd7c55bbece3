"""The images that networks are trained on."""

from dataclasses import dataclass, field
from pathlib import Path

from ..errors import SettingsError
from .appearance import AppearanceRanges

_SHARES = ("two_arms", "same_kinematics", "same_background", "occluded", "things", "absent", "from_photographs")


@dataclass(frozen=True)
class ImageSettings:
    """What training images look like."""

    width: int = 192
    """Width of a training image [px]."""
    height: int = 160
    """Height of a training image [px]."""
    field_width: int = 320
    """Width [px] of the camera image that a training image is a crop of; focal lengths refer to it."""
    two_arms: float = 0.4
    """Share of pairs with two arms."""
    same_kinematics: float = 0.5
    """Share of pairs whose hybrid image shows exactly the kinematics of the observed one."""
    same_background: float = 0.7
    """Share of pairs whose mean background is that of the observed image."""
    occluded: float = 0.4
    """Share of observed images in which something occludes the arms; the labels are those of the arms below it."""
    things: float = 0.35
    """Share of observed images with rods, plates, cables and the like behind the arms."""
    absent: float = 0.1
    """Share of observed images in which one arm or all are claimed to be in view and are not."""
    photographs: Path | None = None
    """Folder of photographs; `from_photographs` of the backgrounds are parts of them."""
    from_photographs: float = 0.2
    """Share of backgrounds that are parts of photographs, if a folder of them is given."""
    recording: Path | None = None
    """Sequence file; arms are then where its cameras see them, about, and not 5 to 25 cm from the camera."""
    coverage: tuple[float, float] = (0.004, 0.5)
    """Allowed share of the image that shows arms."""
    appearance: AppearanceRanges = field(default_factory=AppearanceRanges)
    """The camera's ranges."""

    def __post_init__(self) -> None:
        if self.width % 16 or self.height % 16 or min(self.width, self.height) <= 0:
            raise SettingsError(
                f"training images of {self.width}x{self.height} px; give positive multiples of 16 for both."
            )
        if self.field_width < self.width:
            raise SettingsError(f"field_width is {self.field_width}; give at least the width, {self.width}.")
        for name in _SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(f"{name} is {getattr(self, name)}; give a share from 0 to 1.")
        if not 0 <= self.coverage[0] < self.coverage[1] <= 1:
            raise SettingsError(f"coverage is {self.coverage}; give two shares, the lower one first.")
