"""False positives of the network in the background, found by running it once on the mean background.

The paper compares an image with BG_m + rendering, so background structures that resemble an arm occur in both. The
surface network gets a single image. It is therefore run once on the mean background, and its predictions there are
subtracted from those in an image where the image still shows that background.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..errors import SequenceError
from ..imaging.haze import dehazed, transmission
from ..imaging.working_image import Window, box_mean, pixel_weights, smoothed, stacked_images
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import Scene
from ..recording import MeanBackground
from .predictor import FramePredictor

_PATCH = 3
"""Side of the patches over which differences are averaged [px of the working image]."""

_NOISE = 3.0, 6.0
"""Noise standard deviations above the median at which a difference starts to count, and the further number after which
it counts fully [1].
"""

_CONTRAST = 0.04, 0.10
"""Lower bounds of these two thresholds, for images without noise [1]."""

_FOREIGN = 0.06
"""Median difference above which a background does not belong to the image [1]."""

_UNTELLING = 0.15
"""Difference above which arms may be indistinguishable from other changes, such as moving smoke [1]."""

DECEPTIVE = 0.08
"""Share of a background with false positives above which the background is removed from the network's input [1]."""

_SMOOTH = 12.0
"""Standard deviation of the blur that replaces such a background [px of the working image]."""

_FITS, _SAMPLES = 4, 4
"""Iterations of the robust illumination fit, and its pixel sampling step [px]."""


_KEPT = 4
"""Number of combinations of size, dehazing and predictor for which the backgrounds of a domain are cached."""


@dataclass(frozen=True)
class Change:
    """Difference between images and the empty background."""

    surely: Float[Tensor, "cameras 1 h w"]
    """Confidence that a pixel differs, in [0, 1]; 1 where the background is unknown."""
    telling: Float[Tensor, "cameras 1 h w"]
    """Confidence that an unchanged pixel shows no arm, in [0, 1]: 0 where the background is unknown, in images of
    another scene, and where smoke differs as much as an arm would.
    """


@dataclass(frozen=True)
class Background:
    """Background images of the cameras, at the size of the compared images."""

    images: Float[Tensor, "cameras 3 h w"]
    """RGB in [0, 1]."""
    known: Float[Tensor, "cameras 1 h w"]
    """Confidence that a pixel shows no arm, in [0, 1]."""
    seen: Float[Tensor, "cameras 1 h w"]
    """Coverage predicted in the known background: false positives."""

    def compared(self, images: Float[Tensor, "cameras 3 h w"], scale: float) -> "Change":
        """Compare images (RGB in [0, 1]) with the background under the images' illumination.

        Pixels with unknown background count as different.

        Args:
            scale: image size relative to the working size [1].
        """
        found = [
            self._compared(background, image, scale) for background, image in zip(self.images, images, strict=True)
        ]
        surely = torch.stack([changed for changed, _ in found])
        telling = torch.tensor([clear for _, clear in found], device=surely.device)[:, None, None, None]
        return Change(1.0 - self.known * (1.0 - surely), self.known * telling)

    def _compared(self, background: Tensor, image: Tensor, scale: float) -> tuple[Float[Tensor, "1 h w"], bool]:
        """Confidence that each pixel differs from the background under the image's illumination, in [0, 1], and whether
        an arm would differ.
        """
        difference = (image - _lit_as(background, image)).abs().amax(0, keepdim=True)
        difference = box_mean(difference, 2 * round(_PATCH * scale / 2) + 1)
        usual = float(difference.median())
        if usual > _FOREIGN:
            return torch.ones_like(difference), False
        deviation = 1.4826 * float((difference - usual).abs().median())
        low = max(usual + _NOISE[0] * deviation, _CONTRAST[0])
        width = max(_NOISE[1] * deviation, _CONTRAST[1] - _CONTRAST[0])
        return ((difference - low) / width).clamp(0.0, 1.0), low + width < _UNTELLING


def _lit_as(background: Float[Tensor, "3 h w"], image: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
    """Apply the gain and haze of the image to the background: a robustly fitted line per colour channel."""
    x, y = (values[:, ::_SAMPLES, ::_SAMPLES].flatten(1) for values in (background, image))
    weight = torch.ones_like(x)
    gain, offset = torch.ones(len(x), 1, device=x.device), torch.zeros(len(x), 1, device=x.device)
    for _ in range(_FITS):
        total = weight.sum(1, keepdim=True)
        x_mean, y_mean = (weight * x).sum(1, keepdim=True) / total, (weight * y).sum(1, keepdim=True) / total
        variance = (weight * (x - x_mean).square()).sum(1, keepdim=True) / total
        covariance = (weight * (x - x_mean) * (y - y_mean)).sum(1, keepdim=True) / total
        # A uniform background does not determine the gain, which then stays 1.
        gain = ((covariance + 1e-4) / (variance + 1e-4)).clamp(0.3, 3.0)
        offset = y_mean - gain * x_mean
        error = (y - gain * x - offset).abs()
        scale = 2.0 * error.median(1, keepdim=True).values.clamp(min=0.01)
        weight = 1.0 / (1.0 + (error / scale).square()).square()
    return (gain[..., None] * background + offset[..., None]).clamp(0.0, 1.0)


def without_background(
    images: Float[Tensor, "cameras 3 h w"], changed: Float[Tensor, "cameras 1 h w"], scale: float
) -> Float[Tensor, "cameras 3 h w"]:
    """Composite the changed pixels of images over a blurred background.

    The blur extends smoothly into unknown regions, so that these have no outline.

    Args:
        images: RGB in [0, 1].
        changed: confidence that each pixel differs from the background, in [0, 1].
        scale: image size relative to the working size [1].
    """
    same = 1.0 - changed
    mixed = smoothed(torch.cat([images * same, same], 1), _SMOOTH * scale)
    return changed * images + same * mixed[:, :3] / mixed[:, 3:].clamp(min=1e-3)


class Recording(Protocol):
    """Source of mean backgrounds."""

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """Mean background of a camera in a domain."""
        ...


class Backgrounds:
    """Mean backgrounds of cameras and the network's false positives in them; shared by all frames.

    Args:
        known: camera name -> pixels that certainly show no arm; all pixels by default.
    """

    def __init__(
        self,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        known: Mapping[str, Bool[np.ndarray, "h w"]] | None = None,
        problems: Iterable[str] = (),
    ) -> None:
        self.images, self._known, self.problems = dict(images), dict(known or {}), tuple(problems)
        self._found: dict[tuple[object, ...], Background] = {}

    @staticmethod
    def of(recording: Recording, cameras: Iterable[str], domain: str, *, required: bool = False) -> "Backgrounds":
        """Usable mean backgrounds of a recording's cameras in a domain; cached.

        Args:
            required: whether a loss needs the backgrounds of all cameras, informative or not.

        Raises:
            SequenceError: a required background cannot be estimated, or an image cannot be used.
        """
        kept, key = _MADE.setdefault(recording, {}), (tuple(cameras), domain, required)
        if key not in kept:
            found, problems = {}, []
            for camera in key[0]:
                try:
                    background = recording.mean_background(camera, domain)
                except SequenceError as error:
                    if required:
                        raise
                    problems.append(str(error))
                    continue
                if background.problem is None or required:
                    found[camera] = background
                else:
                    problems.append(background.problem)
            images = {camera: background.image for camera, background in found.items()}
            known = {camera: background.known for camera, background in found.items()}
            kept[key] = Backgrounds(images, known, problems)
        return kept[key]

    @staticmethod
    def forget(recording: Recording) -> None:
        """Drop the cached objects of a recording, which itself caches the mean backgrounds."""
        _MADE.pop(recording, None)

    def covers(self, scene: Scene) -> bool:
        """Whether there is a background for each camera of a scene."""
        return all(camera.name in self.images for camera in scene.cameras)

    def at(self, scene: Scene, size: tuple[int, int], dehaze: float, predictor: FramePredictor) -> Background:
        """Backgrounds of a scene's cameras at a given width and height [px]; `SettingsError` if one is missing or does
        not fit.
        """
        key = tuple(camera.name for camera in scene.cameras), size, dehaze, predictor
        if key not in self._found:
            stacked = stacked_images(scene, self.images, size, "background").to(predictor.device)
            nothing = stacked.new_zeros(len(stacked), SURFACE_CHANNELS, *stacked.shape[-2:])
            clear = dehazed(stacked, transmission(stacked, dehaze))
            predicted = predictor.predict(clear, nothing, Window(0, 0, *size))
            seen = predicted[:, COVERAGE].sum(1, keepdim=True).clamp(0.0, 1.0)
            unknown = {name: ~mask for name, mask in self._known.items()}
            known = pixel_weights(scene, unknown, size).to(seen)
            self._found[key] = Background(stacked, known, seen * known)
            while len(self._found) > _KEPT:
                del self._found[next(iter(self._found))]
        else:
            # The least recently used entry comes first.
            self._found[key] = self._found.pop(key)
        return self._found[key]


_MADE: WeakKeyDictionary[Recording, dict[tuple[tuple[str, ...], str, bool], Backgrounds]] = WeakKeyDictionary()
