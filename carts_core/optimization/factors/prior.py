"""What is known of the unknowns before the image is used."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .base import Linearization


@dataclass(frozen=True)
class Prior:
    """A Gaussian over the unknowns, which may be correlated. Implements `Factor`."""

    mean: Float[Tensor, " n"]
    """[rad]"""
    precision: Float[Tensor, "n n"]
    """Inverse of the covariance [1/rad^2]."""

    @staticmethod
    def around_start(precision: Float[Tensor, " n"]) -> "Prior":
        """Independent errors around 0, of the given inverse variances [1/rad^2]."""
        return Prior(torch.zeros_like(precision), torch.diag(precision))

    def costs(self, offsets: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """Half the squared distance from the mean, in standard deviations [1]."""
        away = offsets - self.mean
        return 0.5 * (away @ self.precision * away).sum(-1)

    def gradient(self, offsets: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Of the cost [1/rad]."""
        return self.precision @ (offsets - self.mean)

    def linearize(self, offsets: Float[Tensor, " n"]) -> Linearization:
        """Exact: the cost is quadratic."""
        return Linearization(float(self.costs(offsets)), self.gradient(offsets), self.precision)

    @property
    def marginal_precision(self) -> Float[Tensor, " n"]:
        """Inverse variance of each unknown [1/rad^2]."""
        return 1.0 / torch.linalg.inv(self.precision.double()).diagonal().to(self.precision)

    @property
    def informs_all(self) -> bool:
        """Whether every unknown has a prior of its own."""
        return bool((self.precision.diagonal() > 0).all())
