"""Observations: images of a frame at the size of comparison, and the surface maps predicted from them.

The paper compares an image with BG_m + rendering, so background structures that resemble an arm occur in both. The
surface network gets a single image. The network is therefore also run once on the mean background; these predictions
are subtracted in the pixels where an image still shows that background.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..errors import SequenceError
from ..imaging.working_image import (
    Window,
    attention,
    box_mean,
    certainty,
    dehazed,
    pixel_weights,
    smoothed,
    stacked_images,
    transmission,
    working_size,
)
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import Scene, SceneState
from ..recording import MeanBackground
from ..rendering import Renderer
from ..settings import SurfaceSolver
from ..settings.stages import Given, Observe
from ..threads import total
from .predictor import FramePredictor

_PATCH = 3
"""Side of the patches over which differences are averaged [px of the working image]."""

_NOISE = 3.0, 6.0
"""Difference above the median, in standard deviations of the noise, at which the confidence starts to rise, and further
increase to full confidence [1].
"""

_CONTRAST = 0.04, 0.10
"""Lower bounds of the differences at which the confidence starts to rise and is full, for images without noise [1]."""

_FOREIGN = 0.06
"""Median difference above which a background does not belong to the image [1]."""

_UNINFORMATIVE = 0.15
"""Difference at full confidence above which arms are not distinguishable from other changes, such as moving smoke
[1]."""

MAX_FALSE_POSITIVES = 0.08
"""Share of a background with false positives above which the background is removed from the network's input [1]."""

_SMOOTH = 12.0
"""Standard deviation of the blur of a background that is removed from the network's input [px of the working image]."""

_FITS, _SAMPLES = 4, 4
"""Iterations of the robust illumination fit, and its pixel sampling step [px]."""


_KEPT = 4
"""Number of combinations of size, dehazing and predictor for which the backgrounds of a domain are cached."""


@dataclass(frozen=True)
class Change:
    """Difference between images and the empty background."""

    differs: Float[Tensor, "cameras 1 h w"]
    """Confidence that a pixel differs, in [0, 1]; 1 where the background is unknown."""
    informative: Float[Tensor, "cameras 1 h w"]
    """Confidence that an unchanged pixel shows no arm, in [0, 1]: 0 where the background is unknown, in images of
    another scene, and where smoke differs from the background as much as an arm would.
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
        differs = torch.stack([changed for changed, _ in found])
        informative = torch.tensor([clear for _, clear in found], device=differs.device)[:, None, None, None]
        return Change(1.0 - self.known * (1.0 - differs), self.known * informative)

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
        return ((difference - low) / width).clamp(0.0, 1.0), low + width < _UNINFORMATIVE


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

    Only unchanged pixels contribute to the blur, which extends smoothly into changed regions.

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
        """Remove the cached objects of a recording; the recording itself caches the mean backgrounds."""
        _MADE.pop(recording, None)

    def covers(self, scene: Scene) -> bool:
        """Whether there is a background for each camera of a scene."""
        return all(camera.name in self.images for camera in scene.cameras)

    def at(self, scene: Scene, size: tuple[int, int], dehaze: float, predictor: FramePredictor) -> Background:
        """Backgrounds of a scene's cameras at a given width and height [px]; `SettingsError` if a background is missing
        or has the wrong size.
        """
        key = tuple(camera.name for camera in scene.cameras), size, dehaze, predictor
        found = self._found.pop(key, None)
        if found is None:
            stacked = stacked_images(scene, self.images, size, "background").to(predictor.device)
            nothing = stacked.new_zeros(len(stacked), SURFACE_CHANNELS, *stacked.shape[-2:])
            clear = dehazed(stacked, transmission(stacked, dehaze))
            predicted = predictor.predict(clear, nothing, Window(0, 0, *size))
            seen = predicted[:, COVERAGE].sum(1, keepdim=True).clamp(0.0, 1.0)
            unknown = {name: ~mask for name, mask in self._known.items()}
            known = pixel_weights(scene, unknown, size).to(seen)
            found = Background(stacked, known, seen * known)
        # The first entry is the least recently used one. Several threads of a tracker may change the entries.
        self._found[key] = found
        while len(self._found) > _KEPT:
            self._found.pop(next(iter(self._found)), None)
        return found


_MADE: WeakKeyDictionary[Recording, dict[tuple[tuple[str, ...], str, bool], Backgrounds]] = WeakKeyDictionary()


MIN_AREA_RATIO = 0.3
"""Share of its initial area below which an arm has left the image [1]."""


@dataclass(frozen=True)
class FrameImages:
    """Images at one size, with pixel weights. Created by `FrameImages.of`."""

    scale: float
    """Size relative to the working image [1]."""
    size: tuple[int, int]
    """Width and height [px]."""
    images: Float[Tensor, "cameras 3 h w"]
    """RGB in [0, 1], dehazed."""
    weight: Float[Tensor, "cameras 1 h w"]
    """Pixel weight: 0 at known occluders, 1 elsewhere."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """Information of a pixel, relative to an image without smoke and haze [1]."""
    explained: Float[Tensor, "cameras 1 h w"] | None
    """Share of the predicted coverage explained by the empty background [1]; None if it is unknown or was replaced."""
    change: Change | None
    """Difference from the empty background; None if the background is unknown."""
    renderer: Renderer
    """Renderer of the whole image."""

    def area_alone(self, state: SceneState, arm: int) -> int:
        """Number of pixels of an arm in all images, without occlusion by other arms."""
        whole = self.renderer.scene
        scene = whole.with_arms([whole.arms[arm].name])
        renderer = Renderer(scene, width=self.size[0], height=self.size[1], device=self.renderer.device)
        alone = replace(
            state,
            joint_positions=(state.joint_positions[arm],),
            T_world_base=state.T_world_base[..., arm : arm + 1, :, :],
        )
        return int((renderer.segment(alone) >= 0).sum())

    def still_in_view(
        self,
        arm: int,
        before: tuple[Int[np.ndarray, "cameras h w"], SceneState],
        after: tuple[Int[np.ndarray, "cameras h w"], SceneState],
    ) -> float:
        """Ratio of an arm's area after and before [1], from labels and state of each; occluded parts count."""
        share = int((after[0] == arm).sum()) / max(int((before[0] == arm).sum()), 1)
        if share >= MIN_AREA_RATIO or len(self.renderer.scene.arms) < 2:
            return share
        return self.area_alone(after[1], arm) / max(self.area_alone(before[1], arm), 1)

    @property
    def replaced(self) -> bool:
        """Whether the unchanged background was replaced in the images."""
        return self.change is not None and self.explained is None

    @staticmethod
    def of(
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        settings: SurfaceSolver,
        predictor: FramePredictor,
        *,
        scale: float = 1.0,
        backgrounds: Backgrounds | None = None,
        replaced: bool | None = None,
    ) -> "FrameImages":
        """Prepare images at `scale` times the working size, rounded to the predictor's stride.

        Args:
            ignore: camera name -> pixels that show an occluder.
            settings: working size and dehazing.
            predictor: predictor of the surface maps; image sizes are multiples of its stride. It is also run once on
                the backgrounds.
            scale: image size relative to the working size [1].
            replaced: whether unchanged background is replaced before prediction; otherwise predictions in the
                background are subtracted. By default, backgrounds with false detections are replaced.

        Raises:
            SettingsError: an image is missing, or the size of an image or mask differs from that of its camera.
        """
        unit, _ = working_size(scene, settings.working_width, predictor.stride)
        size = working_size(scene, round(settings.working_width * scale), predictor.stride)
        stacked = stacked_images(scene, images, size, "image").to(predictor.device)
        # Given masks require no background and, without a network, no dehazing.
        through = transmission(stacked, settings.dehaze if predictor.knows_parts else 0.0)
        explained, change = None, None
        if not predictor.masked and backgrounds is not None and backgrounds.covers(scene):
            background = backgrounds.at(scene, size, settings.dehaze, predictor)
            change = background.compared(stacked, size[0] / unit)
            deceptive = total(background.seen) / background.seen.numel() > MAX_FALSE_POSITIVES
            if deceptive if replaced is None else replaced:
                stacked, through = without_background(stacked, change.differs, size[0] / unit), torch.ones_like(through)
            else:
                explained = background.seen * (1.0 - change.differs)
        return FrameImages(
            scale=size[0] / unit,
            size=size,
            images=dehazed(stacked, through),
            weight=pixel_weights(scene, ignore, size).to(predictor.device),
            # Squared, since smoke degrades predictions more than amplified noise does: docs/explanation/decisions.md.
            certainty=torch.ones_like(through) if predictor.masked else certainty(through).square(),
            explained=explained,
            change=change,
            renderer=Renderer(scene, width=size[0], height=size[1], device=predictor.device),
        )


@dataclass(frozen=True)
class Observation:
    """Predicted surface maps in a window of the images, with weights of their pixels."""

    images: FrameImages
    """The observed images."""
    window: Window
    """Observed part of the images [px of these images]."""
    maps: Float[Tensor, "cameras 6 h w"]
    """Surface maps predicted in the window."""
    weight: Float[Tensor, "cameras 1 h w"]
    """Weight of each pixel: 0 far from the arms and at known occluders."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """Information of a pixel, relative to an image without smoke and haze [1]."""
    knows_parts: bool = True
    """Whether parts and normals are predicted in addition to the coverage of the whole arm."""
    masked: bool = False
    """Whether the coverage comes from given masks."""

    @property
    def coverage(self) -> Float[Tensor, "cameras h w"]:
        """Coverage of all arms, in the window."""
        return self.maps[:, COVERAGE].sum(1)

    @cached_property
    def area(self) -> float:
        """Weighted area of the predicted arms [px of the working image]."""
        return total(self.coverage * (self.weight * self.certainty)[:, 0]) / self.images.scale**2

    def whole_coverage(self) -> Float[Tensor, "cameras height width"]:
        """Coverage of the arms in the whole image, 0 outside the window."""
        coverage = self.coverage
        width, height = self.images.size
        return self.window.paste(coverage, coverage.new_zeros(len(coverage), height, width))


@torch.no_grad()
def observe(
    images: FrameImages, predictor: FramePredictor, state: SceneState, stage: Observe, *, whole: bool = False
) -> Observation:
    """Predict surface maps conditioned on a state unless `stage.given` is `NOTHING`, around its arms or in the whole
    image."""
    given = images.renderer.surface_maps(state)
    everything = whole or predictor.masked
    margin = max(images.size) if everything else round(stage.margin * images.scale)
    reach = round(stage.attention * images.scale)
    window = Window.around(given[:, COVERAGE].sum(1), margin, predictor.stride, images.size)
    condition = torch.zeros_like(given) if stage.given is Given.NOTHING else given
    maps = predictor.predict(images.images, condition, window)
    if images.explained is not None:
        maps = maps * (1.0 - window.of(images.explained))
    silhouette = window.of((given[:, COVERAGE].sum(1) > 0).to(given))
    near = attention(silhouette, reach) if silhouette.any() and not everything else torch.ones_like(silhouette)
    weight = window.of(images.weight) * near[:, None]
    certain = window.of(images.certainty) if stage.haze else torch.ones_like(weight)
    return Observation(images, window, maps, weight, certain, predictor.knows_parts, predictor.masked)
