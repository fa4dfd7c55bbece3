"""Losses between observed and rendered features."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ..settings import Loss
from ..threads import one_thread

_EMPTY = 1e-6


def attention(silhouette: Float[Tensor, "*batch h w"], radius: int) -> Float[Tensor, "*batch h w"]:
    """Att of the paper: the silhouette dilated by `radius` [px], without gradient."""
    flat = silhouette.detach().reshape(-1, *silhouette.shape[-2:])
    size = 2 * radius + 1
    if flat.device.type == "cpu":
        # As fast for a large radius as for a small one.
        square = np.ones((size, size), np.uint8)
        flat = torch.from_numpy(np.stack([cv2.dilate(image, square) for image in flat.contiguous().numpy()]))
    else:
        flat = functional.max_pool2d(flat, (size, 1), stride=1, padding=(radius, 0))
        flat = functional.max_pool2d(flat, (1, size), stride=1, padding=(0, radius))
    return flat.view(silhouette.shape)


def cosine_similarity(
    observed: Float[Tensor, "*batch channels h w"], rendered: Float[Tensor, "*batch channels h w"]
) -> Float[Tensor, "*batch h w"]:
    """sim_cos of the paper, along the channels; two empty features count as equal."""
    dot = (observed * rendered).sum(-3)
    norms = (observed.square().sum(-3) + _EMPTY).sqrt() * (rendered.square().sum(-3) + _EMPTY).sqrt()
    return (dot + _EMPTY) / norms


@one_thread()
def attentional_loss(
    similarity: Float[Tensor, "*batch h w"],
    weight: Float[Tensor, "*batch h w"],
    loss: Loss,
    pixels: int | None = None,
) -> Float[Tensor, "*batch"]:
    """ACS loss of the paper (its equation for L) in one of its forms, per image.

    Args:
        similarity: of features, at most 1; for `l1` the negated difference of predictions.
        weight: attention map, in [0, 1].
        loss: which form.
        pixels: w x h of the whole image, where the maps are a window of it that holds all attention.
    """
    pixels = pixels or similarity.shape[-2] * similarity.shape[-1]
    if loss == "acs_paper":
        return 1.0 - (similarity * weight).sum((-2, -1)) / pixels
    if loss == "acs_reference":
        return ((1.0 - similarity) * weight).sum((-2, -1)) / pixels
    area = weight.sum((-2, -1)).clamp(min=1.0)
    return ((1.0 - similarity) * weight).sum((-2, -1)) / area


@one_thread()
def smooth_l1(observed: Float[Tensor, "*batch h w"], rendered: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch"]:
    """Smooth L1 between predicted probabilities, over the whole image ("CaRTS L1"), per image."""
    return functional.smooth_l1_loss(rendered, observed, reduction="none", beta=0.1).mean((-2, -1))
