"""What an image determines: a standard deviation and a verdict per unknown.

Gauss-Newton's curvature is the inverse covariance of the unknowns, given what was expected of them and what the image
adds. Where the image adds nothing the deviation stays the expected one, and so does the value.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Observability = Literal["determined", "weak", "not visible"]

_DETERMINED, _VISIBLE = 1 / 3, 0.9


@dataclass(frozen=True)
class Uncertainty:
    """How well each unknown is known after an optimization."""

    names: tuple[str, ...]
    """As in `Variables.names`, such as `PSM1/yaw`."""
    std: tuple[float, ...]
    """Standard deviation [rad], [m] for prismatic joints and translations."""
    expected: tuple[float, ...]
    """The same before the image was used."""

    def observability(self, name: str) -> Observability:
        """Whether the image determined an unknown: it has become three times as certain, a little, or not at all."""
        index = self.names.index(name)
        share = self.std[index] / self.expected[index]
        return "determined" if share < _DETERMINED else "weak" if share < _VISIBLE else "not visible"

    def joint_std(self, arm: str, joints: Sequence[str]) -> Float[np.ndarray, " dofs"]:
        """Standard deviation of joint positions of an arm [rad, m]; NaN where a joint was not free."""
        known = dict(zip(self.names, self.std, strict=True))
        return np.array([known.get(f"{arm}/{joint}", np.nan) for joint in joints])


def uncertainty(
    names: list[str],
    curvature: Float[Tensor, "n n"],
    prior: Float[Tensor, " n"],
    scales: Float[Tensor, " n"],
    common: Float[Tensor, " n"],
) -> Uncertainty:
    """From the second derivative of an objective in units of its noise.

    Args:
        names: of the unknowns.
        curvature: J^T J / noise^2 and the prior, per offset.
        prior: inverse variance of each offset before the image was used.
        scales: what an offset of 1 is in units of its unknown.
        common: what the gradient would be off by for one standard deviation of an error that all pixels share. Pixels
            cannot average it out, so it comes on top of what their noise does, but never above what was expected.
    """
    covariance = torch.linalg.inv(curvature.double())
    expected = prior.double().rsqrt() * scales.double()
    variance = covariance.diagonal().clamp(min=0) + (covariance @ common.double()).square()
    std = (variance.sqrt() * scales.double()).minimum(expected)
    return Uncertainty(tuple(names), tuple(std.tolist()), tuple(expected.tolist()))
