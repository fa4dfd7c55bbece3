"""Figures that tell whether the network is good: Dice, and how well features tell aligned from misaligned."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from ...networks.network import FeatureNetwork


@torch.no_grad()
def validate(
    network: FeatureNetwork, images: Float[Tensor, "pairs 2 3 h w"], classes: Int[Tensor, "pairs 2 h w"], batch: int = 4
) -> dict[str, float]:
    """Run a folded network over a validation set: means of

    - `dice_observed`, `dice_hybrid`: Dice of the predicted mask on observed and on hybrid images,
    - `similarity_aligned`: cosine between features of observed and hybrid image where both show an instrument,
    - `similarity_misaligned`: the same where only one of them does.
    """
    dices, aligned, misaligned = [], [], []
    for start in range(0, len(images), batch):
        chunk = images[start : start + batch].to(next(network.parameters()).device)
        mask = (classes[start : start + batch] > 0).to(chunk.device)
        features = network.features(chunk.flatten(0, 1).contiguous(memory_format=torch.channels_last))
        predicted = (network.head(features)[:, 0] > 0).unflatten(0, chunk.shape[:2])
        dices.append(dice(predicted, mask))
        of_pair = features.unflatten(0, chunk.shape[:2])
        similarity = functional.cosine_similarity(of_pair[:, 0], of_pair[:, 1], dim=1)
        aligned.append(similarity[mask[:, 0] & mask[:, 1]])
        misaligned.append(similarity[mask[:, 0] ^ mask[:, 1]])
    mean = torch.cat(dices).mean(0)
    return {
        "dice_observed": float(mean[0]),
        "dice_hybrid": float(mean[1]),
        "similarity_aligned": float(torch.cat(aligned).mean()),
        "similarity_misaligned": float(torch.cat(misaligned).mean()),
    }


def dice(predicted: Tensor, truth: Tensor) -> Tensor:
    """Dice of boolean masks [..., h, w]; 1 where both are empty."""
    overlap = (predicted & truth).sum((-2, -1))
    return (2 * overlap + 1e-9) / (predicted.sum((-2, -1)) + truth.sum((-2, -1)) + 1e-9)


def pooled_dice(predicted: Bool[Tensor, "n h w"], truth: Bool[Tensor, "n h w"]) -> float:
    """Dice of the pixels of all images together; 1 where both are empty.

    A mean over images would hang on those that show no arm: their own Dice is 1, or 0 as soon as one pixel is wrong.
    """
    return float(dice(predicted.flatten(0, 1), truth.flatten(0, 1)))
