"""What is solved for from points in images, and how exactly they were found."""

from dataclasses import dataclass

from ...errors import SettingsError


@dataclass(frozen=True)
class HandEyeSettings:
    """What is solved for from clicked points, and how exactly a person clicks."""

    pixel_error: float = 2.0
    """Expected error of a point [px]."""
    focal_length: bool = False
    """Solve for the focal lengths of all cameras that have points, too."""
    free_cameras: tuple[str, ...] = ()
    """Cameras whose pose relative to the others is not known."""

    def __post_init__(self) -> None:
        if not 0.05 <= self.pixel_error <= 100:
            raise SettingsError(f"pixel_error is {self.pixel_error:g}; allowed is 0.05 to 100 px.")
