"""What a training run needs to know about the network that it trains."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from ...settings import TrainingConfig

Batch = tuple[Tensor, ...]
"""Tensors of bytes, each with a leading dimension of samples."""


class Task(Protocol):
    """A network, what it learns from, and how well it does; without state, so that workers can make their own."""

    columns: ClassVar[dict[str, str]]
    """Validation figures: name -> heading in the report."""
    score: ClassVar[str]
    """The figure that tells whether a network has become better; higher is better."""

    def network(self, config: TrainingConfig) -> nn.Module:
        """A network with random weights."""
        ...

    def generator(self, config: TrainingConfig, stream: Sequence[int]) -> Callable[[int], Any]:
        """Makes the sample of a number, counted from 0; every stream of a seed has others."""
        ...

    def flipped(self, sample: Any, horizontally: bool, vertically: bool) -> Any:
        """A sample mirrored; a mirrored instrument is still one."""
        ...

    def tensors(self, sample: Any) -> Batch:
        """A sample as tensors of bytes."""
        ...

    def loss(self, config: TrainingConfig, network: Any, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted loss, and each term before weighting."""
        ...

    def validate(self, network: Any, batch: Batch) -> dict[str, float]:
        """Figures of a folded network, by the names in `columns`."""
        ...

    def worse(self, now: dict[str, float], first: dict[str, float]) -> bool:
        """Whether a figure besides `score` has become worse than at the start, so that weights are not kept."""
        ...

    def panels(self, network: Any, batch: Batch) -> list[list[tuple[str, np.ndarray]]]:
        """Example predictions of a folded network: per sample, titled pictures."""
        ...


def flips(array: np.ndarray, horizontally: bool, vertically: bool) -> np.ndarray:
    """An image [h, w, ...] mirrored."""
    return array[:: -1 if vertically else 1, :: -1 if horizontally else 1]


def byte_tensor(array: np.ndarray) -> Tensor:
    """An image [h, w, channels] as a tensor [channels, h, w]."""
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))
