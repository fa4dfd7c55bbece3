"""How far training images may vary, and what they may not contain."""

from dataclasses import dataclass

from ..errors import SettingsError

Range = tuple[float, float]

DARKEST_BRIGHTNESS = 0.65
"""Training images are never darkened below this factor: low light is a domain that is only evaluated."""


@dataclass(frozen=True)
class AppearanceRanges:
    """Ranges that the camera of an observed training image is drawn from.

    There is deliberately no smoke, no blood and no low light: robustness to those is to be shown, not trained.
    Nothing red is ever drawn over an instrument, nothing hides a part of the image, and `brightness` has a floor.
    """

    brightness: Range = (0.65, 1.35)
    """Factor on the whole image [1]; at least `DARKEST_BRIGHTNESS`."""
    contrast: Range = (0.6, 1.3)
    """Factor on the distance from the image's mean [1]."""
    gamma: Range = (0.8, 1.25)
    """Exponent of the tone curve [1]."""
    white_balance: Range = (0.82, 1.2)
    """Factor per colour channel [1]."""
    blur: Range = (0.0, 1.1)
    """Standard deviation of the lens blur [px at the working size]."""
    noise: Range = (0.0, 0.03)
    """Standard deviation of the sensor noise [1]."""
    jpeg_quality: Range = (45.0, 98.0)
    """Quality of the JPEG artefacts, 100 is best."""
    vignette: Range = (0.0, 0.45)
    """Darkening in the image corners [1]."""
    unevenness: float = 0.4
    """Largest deviation of the logarithm of the light over the image [1]; its mean is left as it is."""

    def __post_init__(self) -> None:
        if not 0 <= self.unevenness <= 1:
            raise SettingsError(f"unevenness is {self.unevenness}; give a value from 0 to 1.")
        for name in self.__dataclass_fields__:
            if name == "unevenness":
                continue
            low, high = getattr(self, name)
            if not 0 <= low <= high:
                raise SettingsError(f"{name} is ({low}, {high}); give two values with 0 <= lower <= upper.")
        if self.brightness[0] < DARKEST_BRIGHTNESS:
            raise SettingsError(
                f"brightness starts at {self.brightness[0]}, below {DARKEST_BRIGHTNESS}. Low light is a domain that is "
                "evaluated and must not be trained on; raise the lower value."
            )
        if self.gamma[0] == 0 or self.jpeg_quality[1] > 100:
            raise SettingsError("gamma must be positive and jpeg_quality at most 100; correct the range.")
