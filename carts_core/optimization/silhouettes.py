"""A search by how far silhouettes and given masks are apart, which needs no overlap of the two."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..imaging.window import Window
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import SceneState
from ..settings.stages import SilhouetteSearch
from .frame_images import FrameImages
from .predictor import FramePredictor

_COVERED = 0.5
"""Share of a pixel from which it counts as covered [1]."""

_ELITE = 0.1
"""Share of the candidates that the next ones are drawn around [1]."""

_FIRST = 4
"""How many times more candidates the first round has."""

_LEAST = 0.02
"""Smallest deviation that is drawn with, as a share of the first one [1]."""

_HOLD = 0.05
"""What a candidate costs for being one expected deviation off, on average over the unknowns [px]."""


def mask_distances(mask: Bool[np.ndarray, "*cameras h w"]) -> Float[np.ndarray, "*cameras h w"]:
    """Distance of each pixel to a mask, 0 in it; as far as the image is wide where it is empty [px]."""
    flat = mask.reshape(-1, *mask.shape[-2:])
    found = [
        cv2.distanceTransform((~one).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        if one.any()
        else np.full(one.shape, float(one.shape[-1]), np.float32)
        for one in flat
    ]
    return np.stack(found).reshape(mask.shape)


def silhouette_distance(
    rendered: Bool[np.ndarray, "batch cameras h w"],
    masks: Bool[np.ndarray, "cameras h w"],
    weight: Bool[np.ndarray, "cameras h w"],
) -> Float[np.ndarray, " batch"]:
    """Mean distance of silhouettes from masks, and of masks from silhouettes, half of each [px].

    Args:
        rendered: silhouettes of a batch of states.
        masks: the given ones.
        weight: which pixels count.
    """
    to_masks = mask_distances(masks)
    rendered, masks = rendered & weight, masks & weight
    outside = (rendered * to_masks).sum((1, 2, 3)) / rendered.sum((1, 2, 3)).clip(min=1)
    missed = (mask_distances(rendered) * masks).sum((1, 2, 3)) / max(int(masks.sum()), 1)
    # Nothing in view is as wrong as can be.
    outside[~rendered.any((1, 2, 3))] = rendered.shape[-1]
    return 0.5 * (outside + missed)


class SilhouetteComparison:
    """Silhouettes of one frame against its given masks, in small images.

    Args:
        images: in the size that is compared.
        predictor: of the frame; it knows its masks.
    """

    def __init__(self, images: FrameImages, predictor: FramePredictor) -> None:
        nothing = images.images.new_zeros(len(images.images), SURFACE_CHANNELS, *images.images.shape[-2:])
        maps = predictor.predict(images.images, nothing, Window(0, 0, *images.size))
        self._masks = (maps[:, COVERAGE].sum(1) > _COVERED).cpu().numpy()
        self._weight = (images.weight[:, 0] > _COVERED).cpu().numpy()
        self._renderer = images.renderer

    def overlap(self, state: SceneState) -> float:
        """Dice of silhouettes and masks in all cameras together; 1 where both are empty."""
        rendered = (self._renderer.segment(state) >= 0) & self._weight
        masks = self._masks & self._weight
        total = int(rendered.sum()) + int(masks.sum())
        return 2 * int((rendered & masks).sum()) / total if total else 1.0

    def distances(self, states: SceneState) -> Float[np.ndarray, " batch"]:
        """See `silhouette_distance`, of a batch of states."""
        return silhouette_distance(self._renderer.segment(states) >= 0, self._masks, self._weight)


def search_silhouettes(
    distances: Callable[[Float[Tensor, "batch n"]], Float[np.ndarray, " batch"]],
    deviation: Float[Tensor, " n"],
    clamp: Callable[[Tensor], Tensor],
    stage: SilhouetteSearch,
) -> tuple[Float[Tensor, " n"], float]:
    """The point of the smallest distance that was found, and that distance [px]: cross-entropy method, several starts.

    Args:
        distances: between silhouettes and masks at each of a batch of points [px].
        deviation: how far points are drawn from the start at first.
        clamp: brings points into their bounds.
        stage: how many are drawn, and how often.
    """
    best, lowest = torch.zeros_like(deviation), float("inf")
    for start in range(stage.starts):
        generator = torch.Generator().manual_seed(start)
        mean, spread, best_here = torch.zeros_like(deviation), deviation.clone(), best
        for turn in range(stage.rounds):
            count = stage.candidates * (1 if turn else _FIRST)
            drawn = mean + spread * torch.randn(count, len(deviation), generator=generator).to(deviation)
            if turn:
                drawn[0] = best_here
            drawn = clamp(drawn)
            off = (drawn / deviation.clamp(min=1e-12)).square().mean(1).cpu().numpy()
            costs = distances(drawn) + _HOLD * off
            order = torch.from_numpy(np.argsort(costs)[: max(int(_ELITE * count), 2)])
            elite, best_here = drawn[order], drawn[order[0]]
            mean = elite.mean(0)
            spread = elite.std(0) + _LEAST * deviation
            if costs[order[0]] < lowest:
                best, lowest = best_here, float(costs[order[0]])
        if lowest < stage.enough:
            break
    return best, lowest
