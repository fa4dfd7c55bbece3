"""Figures that tell whether the network is good: Dice, and how well features tell aligned from misaligned."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from .network import FeatureNetwork


@dataclass(frozen=True)
class Validation:
    """Means over a validation set."""

    dice_observed: float
    """Dice of the predicted mask on observed images."""
    dice_hybrid: float
    """Dice of the predicted mask on hybrid images."""
    similarity_aligned: float
    """Cosine between features of observed and hybrid image where both show an instrument."""
    similarity_misaligned: float
    """The same where only one of them does."""


@torch.no_grad()
def validate(
    network: FeatureNetwork, images: Float[Tensor, "pairs 2 3 h w"], classes: Int[Tensor, "pairs 2 h w"], batch: int = 4
) -> Validation:
    """Run a network over a validation set. The network's mode is left as it was."""
    folded = network.folded()
    dices, aligned, misaligned = [], [], []
    for start in range(0, len(images), batch):
        chunk = images[start : start + batch].to(next(folded.parameters()).device)
        mask = (classes[start : start + batch] > 0).to(chunk.device)
        features = folded.features(chunk.flatten(0, 1).contiguous(memory_format=torch.channels_last))
        predicted = (folded.head(features)[:, 0] > 0).unflatten(0, chunk.shape[:2])
        dices.append(dice(predicted, mask))
        of_pair = features.unflatten(0, chunk.shape[:2])
        similarity = functional.cosine_similarity(of_pair[:, 0], of_pair[:, 1], dim=1)
        aligned.append(similarity[mask[:, 0] & mask[:, 1]])
        misaligned.append(similarity[mask[:, 0] ^ mask[:, 1]])
    mean = torch.cat(dices).mean(0)
    return Validation(
        float(mean[0]), float(mean[1]), float(torch.cat(aligned).mean()), float(torch.cat(misaligned).mean())
    )


def dice(predicted: Tensor, truth: Tensor) -> Tensor:
    """Dice of boolean masks [..., h, w]; 1 where both are empty."""
    overlap = (predicted & truth).sum((-2, -1))
    return (2 * overlap + 1e-9) / (predicted.sum((-2, -1)) + truth.sum((-2, -1)) + 1e-9)
