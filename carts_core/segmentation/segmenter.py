"""Prompts, the protocol of segmenters, and the built-in segmenter."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from ..errors import SettingsError
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..networks import FeatureExtractor

MOST_POINTS = 100
"""Of one prompt."""


@dataclass(frozen=True)
class Prompt:
    """Prompt for an object in an image: points on it, points beside it, a box around it.

    Raises:
        SettingsError: neither a point on it nor a box, too many points, a place that is not finite, or an empty box.
    """

    inside: tuple[tuple[float, float], ...] = ()
    """Points on it: column and row, pixel centres at 0.5 [px]."""
    outside: tuple[tuple[float, float], ...] = ()
    """Points beside it [px]."""
    box: tuple[float, float, float, float] | None = None
    """Left, top, right and lower end of a box that it is in [px]."""

    def __post_init__(self) -> None:
        if not self.inside and self.box is None:
            raise SettingsError("a prompt needs a point on the thing, or a box around it.")
        if len(self.inside) + len(self.outside) > MOST_POINTS:
            raise SettingsError(f"a prompt has at most {MOST_POINTS} points. Begin another one.")
        numbers = [value for place in (*self.inside, *self.outside, self.box or ()) for value in place]
        if not np.isfinite(numbers).all():
            raise SettingsError("a place of a prompt is not finite.")
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise SettingsError(f"the box {self.box} is empty. Give left, top, right and lower end.")


class Segmenter(Protocol):
    """Protocol of segmenters: segments the object of a prompt."""

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """Mask of the object.

        Raises:
            CartsError: it could not be done.
        """
        ...


_LONGEST_SIDE = 640
"""Of the image that outlines are looked for in [px]."""
_ROUNDS = 3
_BAND, _WIDE = 0.005, 0.2
"""How far from the network's outline, or from the middle of a box in which the network sees nothing, the image decides,
as shares of the image's longer side."""
_POINT, _AROUND = 0.006, 0.05
"""Radius of what a point says for certain, and of what one beside the thing puts in question; shares as above."""
_ALIKE = 25
"""Largest colour difference from a point outside of detections, in steps of 8 bits."""
_SMALLEST = 0.02
"""A piece in a box counts if it is at least this share of the largest."""

Probability = Callable[[UInt8[np.ndarray, "height width 3"]], Float[np.ndarray, "height width"]]


class NetworkSegmenter:
    """Segments instruments; a plug-in of `Segmenter`.

    Args:
        probability: gives the probability that a pixel of an RGB image shows an instrument.
    """

    def __init__(self, probability: Probability) -> None:
        self._probability = probability
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    @staticmethod
    def of(extractor: FeatureExtractor) -> "NetworkSegmenter":
        """By the networks that the optimizer uses."""
        return NetworkSegmenter(lambda image: instrument_probability(extractor, image))

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """Mask of the object; see `Segmenter`."""
        height, width = image.shape[:2]
        scale = min(1.0, _LONGEST_SIDE / max(height, width))
        size = round(width * scale), round(height * scale)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        likely = cv2.resize(self._likely(image), size, interpolation=cv2.INTER_LINEAR) > 0.5
        places = _Places(prompt, scale, size)
        seeds, share = _seeds(small, likely, places)
        found = places.chosen(_outlined(small, places, seeds, share))
        if scale == 1.0:
            return found
        smooth = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        return smooth > 0.5

    def _likely(self, image: np.ndarray) -> np.ndarray:
        # The clicks of a person come on the same image, and the network takes longest.
        if self._last is None or self._last[0] is not image:
            self._last = image, self._probability(image)
        return self._last[1]


@torch.no_grad()
def instrument_probability(
    extractor: FeatureExtractor, image: UInt8[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """Probability that a pixel shows an instrument: unconditioned coverage of the surface network."""
    height, width = image.shape[:2]
    stride = extractor.stride
    scale = extractor.working_size[0] / width
    size = tuple(max(round(side * scale / stride), 1) * stride for side in (width, height))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    images = torch.from_numpy(small).permute(2, 0, 1)[None].to(extractor.device)
    # Where arms are expected is an input of the network; without any, it goes by the image alone.
    nowhere = images.new_zeros(1, SURFACE_CHANNELS, *images.shape[2:])
    coverage = extractor.surface(images, nowhere)[0, COVERAGE].sum(0).float().cpu().numpy()
    return cv2.resize(coverage, (width, height), interpolation=cv2.INTER_LINEAR)


class _Places:
    """A prompt at the size that is worked at."""

    def __init__(self, prompt: Prompt, scale: float, size: tuple[int, int]) -> None:
        self.size = size
        self.longest = max(size)
        self.inside = [self._pixel(place, scale) for place in prompt.inside]
        self.outside = [self._pixel(place, scale) for place in prompt.outside]
        self.box: tuple[int, int, int, int] | None = None
        if prompt.box is not None:
            left, top = self._pixel(prompt.box[:2], scale)
            right, low = self._pixel(prompt.box[2:], scale)
            self.box = left, top, right + 1, low + 1

    def _pixel(self, place: tuple[float, ...], scale: float) -> tuple[int, int]:
        u, v = (
            int(np.clip(np.floor(value * scale), 0, side - 1)) for value, side in zip(place, self.size, strict=True)
        )
        return u, v

    def discs(self, places: list[tuple[int, int]], share: float) -> Bool[np.ndarray, "h w"]:
        """Discs around places."""
        canvas = np.zeros(self.size[::-1], np.uint8)
        for place in places:
            cv2.circle(canvas, place, max(round(share * self.longest), 1), 1, cv2.FILLED)
        return canvas.astype(bool)

    def boxed(self) -> Bool[np.ndarray, "h w"]:
        """The box, or the whole image."""
        inside = np.ones(self.size[::-1], bool)
        if self.box is not None:
            left, top, right, low = self.box
            inside[:] = False
            inside[top:low, left:right] = True
        return inside

    def chosen(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """The pieces that the prompt means: those with a point on them, or in a box all but tiny ones."""
        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        kept = {int(labels[v, u]) for u, v in self.inside}
        if not self.inside and count > 1:
            areas = stats[1:, cv2.CC_STAT_AREA]
            kept = {int(number) + 1 for number in np.flatnonzero(areas >= _SMALLEST * areas.max())}
        dropped = {int(labels[v, u]) for u, v in self.outside}
        return np.isin(labels, list(kept - dropped - {0}))


def _seeds(
    small: np.ndarray, likely: Bool[np.ndarray, "h w"], places: _Places
) -> tuple[Bool[np.ndarray, "h w"], float]:
    """Probable object, and width of the band around its outline in which the image decides."""
    seen = likely & places.boxed()
    if places.inside:
        _, labels = cv2.connectedComponents(seen.astype(np.uint8))
        known = {int(labels[v, u]) for u, v in places.inside} - {0}
        missed = [(u, v) for u, v in places.inside if not labels[v, u]]
        # An instrument may be seen in pieces, so all of them count if one was meant.
        seeds = seen if known else np.zeros_like(seen)
        return (seeds | _alike(small, missed)) & places.boxed(), _BAND
    if seen.any():
        return seen, _BAND
    # Nothing that the network knows is in the box: what differs from its surroundings.
    assert places.box is not None
    left, top, right, low = places.box
    inner = np.zeros_like(seen)
    across, down = max((right - left) // 6, 1), max((low - top) // 6, 1)
    inner[top + down : max(low - down, top + down + 1), left + across : max(right - across, left + across + 1)] = True
    return inner & places.boxed(), _WIDE


def _alike(small: np.ndarray, places: list[tuple[int, int]]) -> Bool[np.ndarray, "h w"]:
    """Regions connected with these pixels, of similar colour."""
    smooth = cv2.bilateralFilter(small, 7, 30, 5)
    found = np.zeros((small.shape[0] + 2, small.shape[1] + 2), np.uint8)
    flags = 8 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    for place in places:
        cv2.floodFill(smooth.copy(), found, place, 0, (_ALIKE,) * 3, (_ALIKE,) * 3, flags)
    return found[1:-1, 1:-1].astype(bool)


def _outlined(
    small: np.ndarray, places: _Places, seeds: Bool[np.ndarray, "h w"], share: float
) -> Bool[np.ndarray, "h w"]:
    """The seeds with an outline along edges."""
    band = max(round(share * places.longest), 2)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    inner = cv2.erode(seeds.astype(np.uint8), disc, borderType=cv2.BORDER_REPLICATE) > 0
    outer = cv2.dilate(seeds.astype(np.uint8), disc) > 0
    states = np.where(seeds, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    states[inner] = cv2.GC_FGD
    states[~outer | ~places.boxed()] = cv2.GC_BGD
    if places.outside:
        doubtful = places.discs(places.outside, _AROUND)
        states[doubtful & (states == cv2.GC_FGD)] = cv2.GC_PR_FGD
        states[places.discs(places.outside, _POINT)] = cv2.GC_BGD
    states[places.discs(places.inside, _POINT) & places.boxed()] = cv2.GC_FGD
    if not np.isin(states, (cv2.GC_FGD, cv2.GC_PR_FGD)).any() or not np.isin(states, (cv2.GC_BGD, cv2.GC_PR_BGD)).any():
        return seeds
    # It begins with clusters of colours, from random centres.
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), states, (0, 0, 1, 1), *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return (states == cv2.GC_FGD) | (states == cv2.GC_PR_FGD)
