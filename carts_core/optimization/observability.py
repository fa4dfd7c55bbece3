"""What an image determines: a standard deviation and a verdict per unknown.

Gauss-Newton's curvature is the inverse covariance of the unknowns, given what was expected of them and what the image
adds. Where the image adds nothing the deviation stays the expected one, and so does the value.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .factors import Prior
from .variables import Variables

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
    """The same before the image was used; at the end of a fit, as large as what it found makes likely."""
    left: tuple[float, ...] | None = None
    """What the image leaves of a deviation as it was expected at the start [1]; None if that is what `expected` is."""

    def observability(self, name: str) -> Observability:
        """Whether the image determined an unknown: it has become three times as certain, a little, or not at all."""
        index = self.names.index(name)
        share = self.std[index] / self.expected[index] if self.left is None else self.left[index]
        return "determined" if share < _DETERMINED else "weak" if share < _VISIBLE else "not visible"

    def joint_std(self, arm: str, joints: Sequence[str]) -> Float[np.ndarray, " dofs"]:
        """Standard deviation of joint positions of an arm [rad, m]; NaN where a joint was not free."""
        known = dict(zip(self.names, self.std, strict=True))
        return np.array([known.get(f"{arm}/{joint}", np.nan) for joint in joints])

    def doubted(self, probability: float) -> "Uncertainty":
        """The same if the fit is wrong with a probability [1]: a wrong fit says nothing beyond what was expected.

        The variance of a mixture of both cases, by the law of total variance.
        """

        def mixed(right: Sequence[float], wrong: Sequence[float]) -> tuple[float, ...]:
            variances = (np.square(values) for values in (right, wrong))
            return tuple(np.sqrt(np.dot((1.0 - probability, probability), list(variances))).tolist())

        left = None if self.left is None else mixed(self.left, [1.0] * len(self.left))
        return replace(self, std=mixed(self.std, self.expected), left=left)

    def scaled(self, later: "Uncertainty") -> "Uncertainty":
        """Deviations for errors of another size; what counts as visible stays what it was for errors as expected."""
        return replace(later, left=tuple(std / given for std, given in zip(self.std, self.expected, strict=True)))


def uncertainty(
    variables: Variables, prior: Prior, curvature: Float[Tensor, "n n"], common: Float[Tensor, " n"], scale: float = 1.0
) -> Uncertainty | None:
    """From the second derivative of an objective in units of its noise; None where the prior leaves an unknown open.

    Args:
        variables: the unknowns.
        prior: of their offsets, before the image was used.
        curvature: J^T J / noise^2 and the prior's precision, per offset.
        common: what the gradient would be off by for one standard deviation of an error that all pixels share. Pixels
            cannot average it out, so it comes on top of what their noise does, but never above what was expected.
        scale: how many times as large as the prior says errors at the start are [1].
    """
    if not prior.informs_all:
        return None
    scales = variables.scales.double()
    covariance = torch.linalg.inv((curvature + (scale**-2 - 1.0) * prior.precision).double())
    expected = scale * prior.marginal_precision.double().rsqrt() * scales
    variance = covariance.diagonal().clamp(min=0) + (covariance @ common.double()).square()
    std = (variance.sqrt() * scales).minimum(expected)
    return Uncertainty(tuple(variables.names), tuple(std.tolist()), tuple(expected.tolist()))


_ROUNDS = 20
"""Of the fixed point of `expected_scale`, which is near after a few [1]."""


def expected_scale(moved: Float[Tensor, " n"], information: Float[Tensor, "n n"], prior: Float[Tensor, "n n"]) -> float:
    """How many times as large as expected the errors of the start probably were, from what a fit has corrected [1].

    Errors of one frame are about as large for joints that it shows as for those that it does not show. This is the
    evidence approximation (MacKay, Bayesian Interpolation, 1992, equation 4.6): the mean square of the corrections,
    over the number of unknowns that the image determines. One more that was as wrong as expected is added, so that an
    image which determines nothing changes nothing.

    Args:
        moved: offsets at the optimum, less the prior's mean.
        information: curvature of the image's part of the objective.
        prior: inverse covariance of the offsets before the image was used.
    """
    information, prior, moved = information.double(), prior.double(), moved.double()
    square, found = float(moved @ prior @ moved), 1.0
    for _ in range(_ROUNDS):
        covariance = torch.linalg.inv(information + prior / found)
        determined = len(moved) - float((covariance @ prior).trace()) / found
        found = (square + 1.0) / (determined + 1.0)
    return found**0.5
