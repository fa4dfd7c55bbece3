"""Prompts, the protocol of segmenters, and the built-in segmenter."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..errors import SettingsError
from ..model.parts import COVERAGE, SURFACE_CHANNELS

if TYPE_CHECKING:
    from ..networks import FeatureExtractor

MAX_POINTS = 100
"""Maximum number of points in a prompt."""


@dataclass(frozen=True)
class Prompt:
    """Prompt for an object in an image: foreground points, background points, and a box.

    Raises:
        SettingsError: the prompt has neither a foreground point nor a box, or it has too many points, a non-finite
            coordinate, or an empty box.
    """

    inside: tuple[tuple[float, float], ...] = ()
    """Foreground points: column and row, pixel centres at 0.5 [px]."""
    outside: tuple[tuple[float, float], ...] = ()
    """Background points: column and row [px]."""
    box: tuple[float, float, float, float] | None = None
    """Left, top, right and bottom of a box around the object [px]."""

    def __post_init__(self) -> None:
        if not self.inside and self.box is None:
            raise SettingsError("a prompt needs a point on the object, or a box around it.")
        if len(self.inside) + len(self.outside) > MAX_POINTS:
            raise SettingsError(f"a prompt may have at most {MAX_POINTS} points. Start another prompt.")
        numbers = [value for place in (*self.inside, *self.outside, self.box or ()) for value in place]
        if not np.isfinite(numbers).all():
            raise SettingsError("a position of a prompt is not finite.")
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise SettingsError(
                f"the box {self.box} is empty. Give left, top, right and bottom with left < right and top < bottom."
            )


class Segmenter(Protocol):
    """Protocol of promptable segmenters."""

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """Mask of the object.

        Raises:
            CartsError: segmentation failed.
        """
        ...


_MAX_SIDE = 640
"""Longer side of the image in which outlines are refined [px]."""
_ROUNDS = 3
_BAND, _WIDE = 0.005, 0.2
"""Half-width of the band that is segmented by image content, around the network's outline or around the initial region
of a box without detections, relative to the longer side of the image [1]."""
_POINT, _AROUND = 0.006, 0.05
"""Radius in which a point determines the label, and radius in which a background point makes foreground uncertain,
relative to the longer side of the image [1]."""
_ALIKE = 25
"""Maximum colour difference in regions grown from points outside detections [grey levels]."""
_SMALLEST = 0.02
"""Minimum area of a connected component in a box, relative to the largest component [1]."""

Probability = Callable[[UInt8[np.ndarray, "height width 3"]], Float[np.ndarray, "height width"]]


class NetworkSegmenter:
    """Segmenter that uses the network and GrabCut; implements `Segmenter`.

    Args:
        probability: predicts the probability of an instrument in each pixel of an RGB image.
    """

    def __init__(self, probability: Probability) -> None:
        self._probability = probability
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    @staticmethod
    def of(extractor: "FeatureExtractor") -> "NetworkSegmenter":
        """Create a segmenter from the optimizer's networks."""
        return NetworkSegmenter(lambda image: instrument_probability(extractor, image))

    def segment(self, image: UInt8[np.ndarray, "height width 3"], prompt: Prompt) -> Bool[np.ndarray, "height width"]:
        """Mask of the object; see `Segmenter`."""
        height, width = image.shape[:2]
        scale = min(1.0, _MAX_SIDE / max(height, width))
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
        # The prediction is cached, since successive prompts usually refer to the same image, and the network is the
        # slowest part.
        if self._last is None or not np.array_equal(self._last[0], image):
            self._last = image.copy(), self._probability(image)
        return self._last[1]


def instrument_probability(
    extractor: "FeatureExtractor", image: UInt8[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """Probability of an instrument in each pixel: unconditioned coverage of the surface network."""
    import torch  # noqa: PLC0415

    height, width = image.shape[:2]
    stride = extractor.stride
    scale = extractor.weights["surface"].working_size[0] / width
    size = tuple(max(round(side * scale / stride), 1) * stride for side in (width, height))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    images = torch.from_numpy(small).permute(2, 0, 1)[None].to(extractor.device)
    # With an empty prior surface map, the network uses only the image.
    nowhere = images.new_zeros(1, SURFACE_CHANNELS, *images.shape[2:])
    with torch.no_grad():
        coverage = extractor.surface(images, nowhere)[0, COVERAGE].sum(0).float().cpu().numpy()
    return cv2.resize(coverage, (width, height), interpolation=cv2.INTER_LINEAR)


class _Places:
    """Prompt in pixels of the downscaled image."""

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
        """Mask of discs around pixels; the radius is `share` of the longer side."""
        canvas = np.zeros(self.size[::-1], np.uint8)
        for place in places:
            cv2.circle(canvas, place, max(round(share * self.longest), 1), 1, cv2.FILLED)
        return canvas.astype(bool)

    def boxed(self) -> Bool[np.ndarray, "h w"]:
        """Mask of the box, or of the whole image without a box."""
        inside = np.ones(self.size[::-1], bool)
        if self.box is not None:
            left, top, right, low = self.box
            inside[:] = False
            inside[top:low, left:right] = True
        return inside

    def chosen(self, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Connected components selected by the prompt: components with a foreground point, or all except tiny
        components in a box; components with a background point are omitted."""
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
    """Mask of the probable object, and relative half-width of the band around its outline that is refined."""
    seen = likely & places.boxed()
    if places.inside:
        _, labels = cv2.connectedComponents(seen.astype(np.uint8))
        known = {int(labels[v, u]) for u, v in places.inside} - {0}
        missed = [(u, v) for u, v in places.inside if not labels[v, u]]
        # An instrument may have several visible components, which are selected together.
        seeds = seen if known else np.zeros_like(seen)
        return (seeds | _alike(small, missed)) & places.boxed(), _BAND
    if seen.any():
        return seen, _BAND
    # Without detections in the box, its central part is assumed to be foreground.
    assert places.box is not None
    left, top, right, low = places.box
    inner = np.zeros_like(seen)
    across, down = max((right - left) // 6, 1), max((low - top) // 6, 1)
    inner[top + down : max(low - down, top + down + 1), left + across : max(right - across, left + across + 1)] = True
    return inner & places.boxed(), _WIDE


def _alike(small: np.ndarray, places: list[tuple[int, int]]) -> Bool[np.ndarray, "h w"]:
    """Regions of similar colour that are connected to these pixels."""
    smooth = cv2.bilateralFilter(small, 7, 30, 5)
    found = np.zeros((small.shape[0] + 2, small.shape[1] + 2), np.uint8)
    flags = 8 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    for place in places:
        cv2.floodFill(smooth.copy(), found, place, 0, (_ALIKE,) * 3, (_ALIKE,) * 3, flags)
    return found[1:-1, 1:-1].astype(bool)


def _outlined(
    small: np.ndarray, places: _Places, seeds: Bool[np.ndarray, "h w"], share: float
) -> Bool[np.ndarray, "h w"]:
    """Refine the outline of the seeds with GrabCut, in a band of relative half-width `share`."""
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
    # GrabCut is initialized by clustering colours from random centres.
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(small[..., ::-1]), states, (0, 0, 1, 1), *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return (states == cv2.GC_FGD) | (states == cv2.GC_PR_FGD)
