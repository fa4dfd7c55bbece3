"""Correspondence lines across the outlines of arms: comparison with colours and edges of an image, without a network.

Between two frames with the network, the outlines of the predicted pose are aligned with the image. Along the normal of
each outline pixel, the colours of the parts and of their surroundings, learnt in earlier frames, and the edges of the
image give a distribution of the position of the outline. The colours follow Stoiber, Sundermeyer and Triebel, Iterative
Corresponding Geometry (CVPR 2022).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..arrays import as_array
from ..compiled import compiled
from ..imaging.working_image import (
    certainty,
    pixel_weights,
    resized_images,
    transmission,
    working_size,
)
from ..model.parts import PARTS
from ..model.scene import Scene, SceneState
from ..rendering import Renderer
from ..rendering.jacobian import Tangents
from ..settings import SurfaceSolver
from ..settings.stages import AlignRegions
from .factors import Linearization, bounded_step
from .image_factors import EDGE_SHARE
from .variables import DIFFERENCE_SPAN, Variables

_SCALE = 2.0
"""Size of the images relative to the working image, limited to the camera's resolution [1]."""
_BITS = 4
"""Bits per colour channel of a histogram."""
_BINS = 1 << 3 * _BITS
_DEEP = 8
"""Distance from an outline within which colours are learnt and compared [px]."""
_SPARSE = 2
"""Number of outline pixels per line [1]."""
_NARROW = 0.35
"""Factor of `AlignRegions.reach` and `robust` in the second half of the steps [1]."""
_LAST = 0.25
"""Factor of `AlignRegions.odds` in the second half of the steps, since the odds of mixed colours are biased [1]."""
_LEAST = 20
"""Minimum number of visible lines of an arm for which a likelihood is computed [1]."""
_FEW = 0.5
"""Pseudocount added to each bin of a histogram [px]."""
_CLEAR = 0.5
"""Information of the arms' pixels relative to an image without haze, below which colours are not learnt [1]."""
_ODDS = 2.0
"""Maximum absolute log odds of a pixel [1]."""


@compiled
def _bin(pixel):
    shift = 8 - _BITS
    return (int(pixel[0]) >> shift) << 2 * _BITS | (int(pixel[1]) >> shift) << _BITS | int(pixel[2]) >> shift


@compiled
def count_colours(images, labels, shown, camera, position, normal, parts, deep, counts):
    """Count the colours of pixels on both sides of outlines.

    Args:
        images [cameras, height, width, 3], labels, shown [cameras, height, width]: 8-bit images, visible part (-1 for
            none), and whether a pixel is compared.
        counts [parts, 2, bins]: output: numbers of pixels of each part (0), and beside it (1).
    """
    height, width = labels.shape[1:]
    for k in range(len(camera)):
        for step in range(-deep, deep + 1):
            x = round(position[0, k] + step * normal[0, k])
            y = round(position[1, k] + step * normal[1, k])
            if step == 0 or x < 0 or y < 0 or x >= width or y >= height or not shown[camera[k], y, x]:
                continue
            inside = labels[camera[k], y, x] == parts[k]
            if inside == (step < 0):
                counts[parts[k], 0 if inside else 1, _bin(images[camera[k], y, x])] += 1.0


@compiled
def _sample(image, visible, odds_of_bins, x0, y0, nx, ny, deep, odds, colours):
    """Fill log odds [samples] and colours [samples, 3] along a line, half a pixel apart; returns the number of visible
    samples."""
    height, width = visible.shape
    seen = 0
    for s in range(len(odds)):
        away = np.float32(0.5) * (s - 2 * deep)
        # Beyond the image border, the colours of the border continue.
        x = min(max(x0 + away * nx, np.float32(0.0)), np.float32(width - 1))
        y = min(max(y0 + away * ny, np.float32(0.0)), np.float32(height - 1))
        column, row = min(int(x), width - 2), min(int(y), height - 2)
        u, v = np.float32(x - column), np.float32(y - row)
        upper, lower = image[row], image[row + 1]
        for c in range(3):
            above = upper[column, c] + u * (np.float32(upper[column + 1, c]) - upper[column, c])
            below = lower[column, c] + u * (np.float32(lower[column + 1, c]) - lower[column, c])
            colours[s, c] = above + v * (below - above)
        near_column, near_row = int(x + np.float32(0.5)), int(y + np.float32(0.5))
        odds[s] = 0.0
        if visible[near_row, near_column]:
            seen += 1
            odds[s] = odds_of_bins[_bin(image[near_row, near_column])]
    return seen


_TAPS = 3
"""Half the width of the filter for edges [samples]."""


@compiled
def _edge(colours, s):
    """Squared derivative of the colours along a line, under a blur of about one pixel."""
    squared = np.float32(0.0)
    for c in range(3):
        change = colours[s + 2, c] - colours[s - 2, c]
        change += np.float32(0.6) * (colours[s + 1, c] - colours[s - 1, c] + colours[s + 3, c] - colours[s - 3, c])
        squared += change * change
    return squared


@compiled
def sample_lines(images, shown, camera, position, normal, parts, log_odds, deep, floor, difference, edges, seen):
    """Sample colours and edges along lines across outlines, half a pixel apart.

    Args:
        images, shown: see `count_colours`.
        camera [K], position, normal [2, K], parts [K]: outline pixels.
        log_odds [parts, bins]: of each part against its surroundings.
        deep: length of a line on either side [px].
        floor: squared difference of colours that counts as noise [1].
        difference [K, samples]: output: log odds of the samples inside an outline at a sample, minus those outside.
        edges [K, samples]: output: logarithm of the squared strength of the edge at a sample.
        seen [K]: output: number of visible samples.
    """
    samples = 4 * deep + 1
    odds, colours = np.empty(samples, np.float32), np.empty((samples, 3), np.float32)
    for k in range(len(camera)):
        lines = position[0, k], position[1, k], normal[0, k], normal[1, k]
        seen[k] = _sample(images[camera[k]], shown[camera[k]], log_odds[parts[k]], *lines, deep, odds, colours)
        balance = -odds.sum()
        for s in range(samples):
            difference[k, s] = balance + odds[s]
            balance += np.float32(2.0) * odds[s]
            if _TAPS <= s < samples - _TAPS:
                edges[k, s] = np.log(_edge(colours, s) + floor)


@compiled
def find_contours(difference, edges, shift, deep, reach, odds_weight, edge_weight, out):
    """Distribution of the position of an outline along each line.

    The likelihood of a distance is the product of the odds of the colours, for a boundary there, and of the strength
    of the edge there.

    Args:
        difference, edges [K, samples]: see `sample_lines`.
        shift [K]: positions of the outlines along the lines [px].
        reach: standard deviation of the expected distance [px].
        odds_weight: exponent of the odds, since colours of neighbouring pixels are correlated [1].
        edge_weight: exponent of the squared strength of edges [1].
        out [3, K]: mean and variance of the distance along the normal [px, px^2], and log odds of both sides of the
            outline [1].
    """
    samples, half = difference.shape[1], np.float32(0.5)
    score = np.empty(samples, np.float32)
    for k in range(len(difference)):
        best = np.float32(-np.inf)
        for s in range(_TAPS, samples - _TAPS):
            away = half * (s - 2 * deep) - shift[k]
            score[s] = half * (odds_weight * difference[k, s] - (away / reach) ** 2) + edge_weight * edges[k, s]
            best = max(best, score[s])
        mass, mean, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for s in range(_TAPS, samples - _TAPS):
            away, weight = half * (s - 2 * deep) - shift[k], np.exp(score[s] - best)
            mass += weight
            mean += weight * away
            square += weight * away * away
        mean /= mass
        out[0, k], out[1, k] = mean, max(square / mass - mean * mean, np.float32(0.0))
        out[2, k] = difference[k, min(max(2 * deep + round(2 * shift[k]), 0), samples - 1)]


@dataclass(frozen=True)
class ColourModel:
    """Histograms of the colours of each part and of its surroundings, near the outlines."""

    counts: Float[np.ndarray, "parts 2 bins"]
    """Numbers of pixels of each colour, inside and outside [px]."""

    def log_odds(self) -> Float[np.ndarray, "parts bins"]:
        """Log odds of each part against its surroundings for each colour [1]."""
        sums = self.counts.sum(-1, keepdims=True)
        shares = (self.counts + _FEW) / (sums + _FEW * _BINS)
        odds = np.log(shares[:, 0] / shares[:, 1]).clip(-_ODDS, _ODDS)
        return odds.astype(np.float32)

    def updated(self, other: "ColourModel", share: float) -> "ColourModel":
        """Average with a newer model of the given weight in [0, 1]."""
        return ColourModel((1.0 - share) * self.counts + share * other.counts)


@dataclass(frozen=True)
class Alignment:
    """Result of an alignment of outlines with colours and edges."""

    offsets: Float[Tensor, " n"]
    model: Linearization
    """Quadratic model of the lines around the result."""
    likelihood: Float[np.ndarray, " arms"]
    """Mean log odds of the colours on both sides of each arm's outlines [1]: about 0 if the image does not show the arm
    there, `_ODDS` if its colours occur nowhere else; NaN for an arm with fewer than `_LEAST` visible lines."""


class RegionImages:
    """Images of a frame, resized for the correspondence lines, without other preparation.

    Args:
        ignore: camera name -> pixels that show an occluder.

    Raises:
        SettingsError: an image is missing, or the size of an image or mask differs from that of its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        settings: SurfaceSolver,
    ) -> None:
        size = working_size(scene, round(settings.working_width * _SCALE), 1)
        self._dehaze = settings.dehaze
        self.renderer = Renderer(scene, width=size[0], height=size[1])
        self.images = resized_images(scene, images, size, "image")
        shape = len(self.images), size[1], size[0]
        hidden = as_array(pixel_weights(scene, ignore, size))[:, 0] < 1.0 if ignore else np.zeros(shape, bool)
        self.shown: Bool[np.ndarray, "cameras h w"] = ~hidden

    def learnt(self, state: SceneState) -> ColourModel | None:
        """Colours at the outlines of a state; None without arms in view, or if haze hides them."""
        links, cameras = sum(len(arm.robot.link_names) for arm in self.renderer.scene.arms), len(self.images)
        nothing = Tangents(torch.zeros(0, cameras, links, 4, 4), torch.zeros(0, cameras, 4))
        labels = self.renderer.segment_parts(state).astype(np.int8)
        through = transmission(torch.from_numpy(self.images[:, ::2, ::2]).permute(0, 3, 1, 2) / 255.0, self._dehaze)
        arms = labels[:, ::2, ::2] >= 0
        if not arms.any() or float(certainty(through).numpy()[:, 0][arms].mean()) < _CLEAR:
            return None
        outline = self.renderer.outline(state, nothing)
        counts = np.zeros((len(PARTS), 2, _BINS), np.float32)
        values = outline.camera, outline.position, outline.normal, outline.parts
        count_colours(self.images, labels, self.shown, *map(as_array, values), _DEEP, counts)
        return ColourModel(counts)


class RegionFactor:
    """Half the weighted squared distances of outlines from the positions that colours and edges indicate."""

    def __init__(self, images: RegionImages, variables: Variables, colours: ColourModel, stage: AlignRegions) -> None:
        self._images, self._variables, self._stage = images, variables, stage
        self._log_odds, self._arms = colours.log_odds(), len(images.renderer.scene.arms)
        self.likelihood = np.full(self._arms, np.nan)

    def render(self, offsets: Float[Tensor, " n"]) -> None:
        """Draw lines across the outlines of a point."""
        renderer, variables = self._images.renderer, self._variables
        tangents = renderer.tangents(variables.around(offsets), DIFFERENCE_SPAN)
        outline = renderer.outline(variables.state(offsets), tangents, share=1.0 / _SPARSE)
        self._motion, self._lines_arms, parts = map(as_array, (outline.motion, outline.arms, outline.parts))
        shape = len(parts), 4 * _DEEP + 1
        self._difference, self._edges, seen = (np.empty(size, np.float32) for size in (shape, shape, len(parts)))
        sample_lines(
            self._images.images,
            self._images.shown,
            *map(as_array, (outline.camera, outline.position, outline.normal)),
            parts,
            self._log_odds,
            _DEEP,
            np.float32(self._stage.floor),
            self._difference,
            self._edges,
            seen,
        )
        self._seen = np.maximum(seen, 1.0)
        self._shown = (2.0 * seen > shape[1]).astype(np.float32)
        self._share = EDGE_SHARE[parts] * self._shown
        self._rendered_at = offsets

    def linearize(self, offsets: Float[Tensor, " n"], narrow: float = 1.0) -> Linearization:
        """Quadratic model around a point.

        Args:
            narrow: factor of the expected distance between outline and image [1].
        """
        stage, motion = self._stage, self._motion
        shift = as_array(offsets - self._rendered_at) @ motion
        found = np.empty((3, len(shift)), np.float32)
        find_contours(
            self._difference,
            self._edges,
            shift,
            _DEEP,
            np.float32(stage.reach * narrow),
            np.float32(stage.odds * (_LAST if narrow < 1.0 else 1.0)),
            np.float32(stage.edges),
            found,
        )
        mean, variance, support = found
        support = support / self._seen
        weight = self._share / (1.0 + variance / stage.spread**2)
        sums, counts = (
            np.bincount(self._lines_arms, values, self._arms) for values in (support * self._shown, self._shown)
        )
        self.likelihood = np.where(counts >= _LEAST, sums / np.maximum(counts, 1.0), np.nan)
        # Smoke reduces the odds, and hides the true edges.
        weight *= np.nan_to_num(self.likelihood).clip(0.0, 1.0)[self._lines_arms] ** 2
        weight /= (1.0 + (mean / (stage.robust * narrow)) ** 2) ** 2
        weighted = stage.weight * _SPARSE * weight * motion
        gradient, hessian = (
            torch.from_numpy(values.astype(np.float32)) for values in (-weighted @ mean, weighted @ motion.T)
        )
        cost = 0.5 * stage.weight * _SPARSE * float((weight * mean**2).sum())
        return Linearization(cost, gradient, hessian)


@torch.no_grad()
def align_regions(
    factor: RegionFactor, prior: Linearization, stage: AlignRegions, offsets: Float[Tensor, " n"], variables: Variables
) -> Alignment:
    """Minimize the sum of the region factor and a quadratic model.

    Args:
        prior: quadratic model of all other factors at `offsets`.
    """
    origin = offsets
    factor.render(offsets)
    found = None
    step = torch.zeros_like(offsets)
    for turn in range(stage.steps):
        narrow = 1.0 if turn < stage.steps // 2 else _NARROW
        found, before = factor.linearize(offsets, narrow), offsets
        gradient = prior.gradient + prior.hessian @ (before - origin) + found.gradient
        step = bounded_step(before, gradient, prior.hessian + found.hessian, variables.lower, variables.upper)
        offsets = variables.clamp(before + step.to(offsets))
        step = offsets - before
    assert found is not None
    model = Linearization(found.cost, found.gradient + found.hessian @ step, found.hessian)
    return Alignment(offsets, model, factor.likelihood)
