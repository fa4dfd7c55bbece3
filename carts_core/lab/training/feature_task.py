"""Learning the paper's features: what `FeatureNetwork` is trained on, and how well it does."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ...model.robot import Robot
from ...networks.network import FeatureNetwork
from ...settings import TrainingConfig
from ..randomization import PairGenerator, TrainingPair
from .objective import feature_loss
from .task import Batch, flips
from .validation import validate


class FeatureTask:
    """See `Task`. A batch is images [batch, 2, 3, h, w] and classes [batch, 2, h, w] of observed and hybrid images."""

    columns: ClassVar[dict[str, str]] = {
        "dice_observed": "Dice, observed",
        "dice_hybrid": "Dice, hybrid",
        "similarity_aligned": "cosine, aligned",
        "similarity_misaligned": "cosine, misaligned",
    }
    score: ClassVar[str] = "dice_observed"

    def network(self, config: TrainingConfig) -> FeatureNetwork:
        """A network with random weights."""
        return FeatureNetwork(config.architecture)

    def generator(self, config: TrainingConfig, stream: Sequence[int]) -> PairGenerator:
        """An endless source of pairs."""
        return PairGenerator([Robot.load(path) for path in config.robots], config.images, stream)

    def flipped(self, sample: TrainingPair, horizontally: bool, vertically: bool) -> TrainingPair:
        """A pair mirrored."""
        parts = sample.observed, sample.observed_classes, sample.hybrid, sample.hybrid_classes
        return TrainingPair(*(flips(part, horizontally, vertically) for part in parts))

    def tensors(self, sample: TrainingPair) -> Batch:
        """A pair as tensors of bytes."""
        images = np.stack([sample.observed, sample.hybrid]).transpose(0, 3, 1, 2)
        classes = np.stack([sample.observed_classes, sample.hybrid_classes])
        return torch.from_numpy(np.ascontiguousarray(images)), torch.from_numpy(np.ascontiguousarray(classes))

    def loss(self, config: TrainingConfig, network: FeatureNetwork, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss, and each term before weighting."""
        images, classes = batch
        return feature_loss(network, images.float() / 255, classes, config.objective)

    def validate(self, network: FeatureNetwork, batch: Batch) -> dict[str, float]:
        """Figures of a folded network."""
        return validate(network, batch[0].float() / 255, batch[1])

    def worse(self, now: dict[str, float], first: dict[str, float]) -> bool:
        """See `Task`; the score says all."""
        return False

    @torch.no_grad()
    def panels(self, network: FeatureNetwork, batch: Batch) -> list[list[tuple[str, np.ndarray]]]:
        """Example predictions of a folded network."""
        rows = []
        for pair, truth in zip(batch[0].float() / 255, batch[1].cpu().numpy() > 0, strict=True):
            features = network.features(pair.to(next(network.parameters()).device))
            predicted = (network.head(features)[:, 0] > 0).cpu().numpy()
            similarity = functional.cosine_similarity(features[:1], features[1:], dim=1)[0].cpu().numpy()
            shown = pair.permute(0, 2, 3, 1).cpu().numpy()
            rows.append(
                [
                    ("observed", shown[0]),
                    ("its prediction", _confusion(predicted[0], truth[0])),
                    ("hybrid", shown[1]),
                    ("its prediction", _confusion(predicted[1], truth[1])),
                    ("cosine of features", similarity),
                ]
            )
        return rows


def _confusion(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """True positives white, true negatives black, false positives orange, false negatives red, as in the paper."""
    image = np.zeros((*truth.shape, 3))
    image[predicted & truth] = 1, 1, 1
    image[predicted & ~truth] = 1, 0.6, 0.1
    image[~predicted & truth] = 0.9, 0.1, 0.1
    return image
