"""What training minimises: the paper's cross-entropy, and terms that make features comparable across images."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from ...networks.network import FeatureNetwork
from ...settings import ObjectiveWeights

_NEIGHBOURHOOD = 21
_TINY = 1e-8
_OTHER_PART = 0.6


def feature_loss(
    network: FeatureNetwork,
    images: Float[Tensor, "batch pair 3 h w"],
    classes: Int[Tensor, "batch pair h w"],
    weights: ObjectiveWeights,
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted loss of a batch of pairs, and each term before weighting.

    Args:
        network: the network that is trained.
        images: observed image and hybrid image of each pair, RGB in [0, 1].
        classes: 0 background, 1 shaft, 2 head.
        weights: of the terms.
    """
    features = network.features(images.flatten(0, 1).contiguous(memory_format=torch.channels_last))
    logits = network.head(features)[:, 0]
    target = (classes > 0).flatten(0, 1).to(logits.dtype)
    of_pair = features.unflatten(0, images.shape[:2])
    terms = {
        "cross_entropy": functional.binary_cross_entropy_with_logits(logits, target),
        "dice": soft_dice_loss(logits.sigmoid(), target),
        "consistency": consistency_loss(of_pair[:, 0], of_pair[:, 1], classes[:, 0], classes[:, 1]),
    }
    return torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum(), terms


def soft_dice_loss(probability: Float[Tensor, "batch h w"], target: Float[Tensor, "batch h w"]) -> Float[Tensor, ""]:
    """One minus the Dice score of probabilities, averaged over images."""
    overlap = (probability * target).sum((1, 2))
    return 1 - ((2 * overlap + 1) / (probability.sum((1, 2)) + target.sum((1, 2)) + 1)).mean()


def consistency_loss(
    features_a: Float[Tensor, "batch channels h w"],
    features_b: Float[Tensor, "batch channels h w"],
    classes_a: Int[Tensor, "batch h w"],
    classes_b: Int[Tensor, "batch h w"],
) -> Float[Tensor, ""]:
    """How far cosine similarities are from what alignment needs, near the instruments (where ACS attends).

    Where both images show the same class the cosine should be 1; where one shows background and the other an
    instrument, not above 0; where one shows the shaft and the other the head, not above 0.6. Each of these counts by
    its own mean, since background would outweigh instruments otherwise.
    """
    overlap = (features_a * features_b).sum(1)
    similarity = overlap * torch.rsqrt(features_a.square().sum(1) * features_b.square().sum(1) + _TINY)
    instrument = ((classes_a > 0) | (classes_b > 0)).to(similarity.dtype)
    near = dilated(instrument)
    same = (classes_a == classes_b).to(similarity.dtype)
    moved = ((classes_a > 0) != (classes_b > 0)).to(similarity.dtype)
    other_part = instrument * (classes_a != classes_b) * (1 - moved)
    return (
        weighted_mean(1 - similarity, same * instrument)
        + weighted_mean(1 - similarity, same * near * (1 - instrument))
        + weighted_mean(similarity.clamp(min=0), moved)
        + weighted_mean((similarity - _OTHER_PART).clamp(min=0), other_part)
    )


def dilated(mask: Float[Tensor, "batch h w"]) -> Float[Tensor, "batch h w"]:
    """The mask and its neighbourhood."""
    # A square's maximum is the maximum along rows of the maxima along columns.
    rows = functional.max_pool2d(mask[:, None], (_NEIGHBOURHOOD, 1), 1, (_NEIGHBOURHOOD // 2, 0))
    return functional.max_pool2d(rows, (1, _NEIGHBOURHOOD), 1, (0, _NEIGHBOURHOOD // 2))[:, 0]


def weighted_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Mean under weights; about zero where all weights are."""
    return (values * weights).sum() / (weights.sum() + 1)
