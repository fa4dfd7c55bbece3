"""What is known of the unknowns before the image is looked at."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Prior:
    """A Gaussian over the unknowns, which may be correlated."""

    mean: Float[Tensor, " n"]
    """[rad]"""
    precision: Float[Tensor, "n n"]
    """Inverse of the covariance [1/rad^2]."""

    def value(self, offsets: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """Half the squared distance from the mean, in standard deviations [1]."""
        away = offsets - self.mean
        return 0.5 * (away @ self.precision * away).sum(-1)

    def gradient(self, offsets: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Of `value` [1/rad]."""
        return self.precision @ (offsets - self.mean)

    @property
    def marginal(self) -> Float[Tensor, " n"]:
        """Inverse variance of each unknown [1/rad^2]."""
        return 1.0 / torch.linalg.inv(self.precision.double()).diagonal().to(self.precision)
