"""False positives of the network in the background, found by running it once on the mean background.

The paper compares an image with BG_m + rendering, so whatever resembles an arm in the background is in both. The
surface network has one image at a time. It is run once on the mean background, and what it predicts there is
subtracted from its predictions in an image, as far as the image still shows that background.
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
"""A difference counts from so many deviations of the noise beyond its median on, and in full so many later [1]."""

_CONTRAST = 0.04, 0.10
"""The same at least, for images without noise [1]."""

_FOREIGN = 0.06
"""Median difference from which a background is not that of the image [1]."""

_UNTELLING = 0.15
"""Difference above which arms need not be visible as a change, as in moving smoke [1]."""

DECEPTIVE = 0.08
"""Share of a background with false positives from which the network gets images without that background [1]."""

_SMOOTH = 12.0
"""Deviation of the blur that replaces such a background [px of the working image]."""

_FITS, _SAMPLES = 4, 4
"""Rounds of the robust fit of light, and the step between the pixels that it looks at [px]."""


_KEPT = 4
"""Sizes, treatments of haze and predictors for which the backgrounds of a domain are kept."""


@dataclass(frozen=True)
class Change:
    """Difference of images and the empty background."""

    surely: Float[Tensor, "cameras 1 h w"]
    """Confidence that a pixel differs, in [0, 1]; 1 where the background is not known."""
    telling: Float[Tensor, "cameras 1 h w"]
    """How far a pixel that does not differ shows no arm, in [0, 1]: 0 where the background is not known, in images of
    another scene, and where smoke differs as much as an arm would."""


@dataclass(frozen=True)
class Background:
    """Images of the cameras without arms, in the size of the compared images."""

    images: Float[Tensor, "cameras 3 h w"]
    """RGB in [0, 1]."""
    known: Float[Tensor, "cameras 1 h w"]
    """Confidence that they show no arm, in [0, 1]."""
    seen: Float[Tensor, "cameras 1 h w"]
    """Predicted coverage where they are known: false positives."""

    def compared(self, images: Float[Tensor, "cameras 3 h w"], scale: float) -> "Change":
        """Images, RGB in [0, 1], beside the background under their light.

        What is not known to be background counts as different.

        Args:
            scale: times the working size [1].
        """
        found = [
            self._compared(background, image, scale) for background, image in zip(self.images, images, strict=True)
        ]
        surely = torch.stack([changed for changed, _ in found])
        telling = torch.tensor([clear for _, clear in found], device=surely.device)[:, None, None, None]
        return Change(1.0 - self.known * (1.0 - surely), self.known * telling)

    def _compared(self, background: Tensor, image: Tensor, scale: float) -> tuple[Float[Tensor, "1 h w"], bool]:
        """How surely each pixel differs from the background under the image's light, in [0, 1], and whether an arm
        would."""
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
    """The background under the gain and the haze of the image: a line per colour, fitted robustly."""
    x, y = (values[:, ::_SAMPLES, ::_SAMPLES].flatten(1) for values in (background, image))
    weight = torch.ones_like(x)
    gain, offset = torch.ones(len(x), 1, device=x.device), torch.zeros(len(x), 1, device=x.device)
    for _ in range(_FITS):
        total = weight.sum(1, keepdim=True)
        x_mean, y_mean = (weight * x).sum(1, keepdim=True) / total, (weight * y).sum(1, keepdim=True) / total
        variance = (weight * (x - x_mean).square()).sum(1, keepdim=True) / total
        covariance = (weight * (x - x_mean) * (y - y_mean)).sum(1, keepdim=True) / total
        # A background of one colour says nothing of the gain; then it stays 1.
        gain = ((covariance + 1e-4) / (variance + 1e-4)).clamp(0.3, 3.0)
        offset = y_mean - gain * x_mean
        error = (y - gain * x - offset).abs()
        scale = 2.0 * error.median(1, keepdim=True).values.clamp(min=0.01)
        weight = 1.0 / (1.0 + (error / scale).square()).square()
    return (gain[..., None] * background + offset[..., None]).clamp(0.0, 1.0)


def without_background(
    images: Float[Tensor, "cameras 3 h w"], changed: Float[Tensor, "cameras 1 h w"], scale: float
) -> Float[Tensor, "cameras 3 h w"]:
    """Changed pixels of images, before a blurred background.

    The blurred background goes on smoothly where it is not known, so that what is there has no outline.

    Args:
        images: RGB in [0, 1].
        changed: how surely each pixel differs from the background, in [0, 1].
        scale: times the working size [1].
    """
    same = 1.0 - changed
    mixed = smoothed(torch.cat([images * same, same], 1), _SMOOTH * scale)
    return changed * images + same * mixed[:, :3] / mixed[:, 3:].clamp(min=1e-3)


class Recording(Protocol):
    """Source of mean backgrounds."""

    def mean_background(self, camera: str, domain: str | None = None) -> MeanBackground:
        """Of a camera, in a domain."""
        ...


class Backgrounds:
    """The mean backgrounds of cameras, and the network's false positives in them; one object serves all frames.

    Args:
        known: camera name -> where it certainly shows no arm; everywhere by default.
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
        """Those of a recording's cameras in a domain that say what is there without arms; made once, then kept.

        Args:
            required: whether a loss needs them all, whatever they can say.

        Raises:
            SequenceError: they are required, and one cannot be estimated, or an image is not usable.
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
        """Whether the background of each camera of a scene is there."""
        return all(camera.name in self.images for camera in scene.cameras)

    def at(self, scene: Scene, size: tuple[int, int], dehaze: float, predictor: FramePredictor) -> Background:
        """Backgrounds of a scene's cameras in a width and height [px]; `SettingsError` if one is missing or misfits."""
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
            # The one that was used least lately comes first.
            self._found[key] = self._found.pop(key)
        return self._found[key]


_MADE: WeakKeyDictionary[Recording, dict[tuple[tuple[str, ...], str, bool], Backgrounds]] = WeakKeyDictionary()
