"""Evaluations of an objective, and standard deviations of its unknowns."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from .factors import Prior
from .results import Uncertainty
from .variables import Variables


def uncertainty(
    variables: Variables, prior: Prior, curvature: Float[Tensor, "n n"], outline_gradient: Float[Tensor, " n"]
) -> Uncertainty | None:
    """Uncertainty under a prior, from the curvature of an objective in units of its noise.

    Args:
        prior: prior of the offsets, before the image was used.
        curvature: J^T J / noise^2 plus the prior's precision, per offset.
        outline_gradient: change of the gradient for one standard deviation of an error common to all outlines. This
            error does not average out, so its effect is added to that of the noise, up to the prior.

    Returns:
        The uncertainty; None if the prior does not constrain an unknown.
    """
    if not (prior.precision.diagonal() > 0).all():
        return None
    covariance = torch.linalg.inv(curvature.double())
    return _uncertainty(variables, prior, covariance, covariance @ outline_gradient.double())


def uncertainty_after(
    variables: Variables,
    prior: Prior,
    curvature: Float[Tensor, "n n"],
    outline_gradient: Float[Tensor, " n"],
    moved: Float[Tensor, " n"],
    start_share: float,
) -> Uncertainty:
    """Uncertainty under a prior that is rescaled by the size of the corrections.

    The fit is the optimum under the original prior, so part of an error e of the start remains:
    (I + P)^-1 (P + a I) e, where I is the image's information, P the prior's precision and a the share of the start in
    the network's prediction. The noise of the image is added.

    Args:
        prior: prior of the offsets, before the image was used; it must constrain all of them.
        curvature: J^T J / noise^2 plus the prior's precision, per offset.
        moved: offsets at the optimum, minus the prior's mean.
        start_share: share of an error of the start that remains in the network's prediction [1].
    """
    precision, curvature = prior.precision.double(), curvature.double()
    information, inverse = curvature - precision, torch.linalg.inv(curvature)
    scale = expected_scale(moved, information, precision, start_share)
    left = inverse @ (precision + start_share * information)
    covariance = scale**2 * left @ torch.linalg.inv(precision) @ left.T + inverse @ information @ inverse
    return _uncertainty(variables, prior, covariance, inverse @ outline_gradient.double(), scale)


def _uncertainty(
    variables: Variables,
    prior: Prior,
    covariance: Float[Tensor, "n n"],
    outline_shift: Float[Tensor, " n"],
    scale: float = 1,
) -> Uncertainty:
    scales = variables.scales.double()
    expected = scale * prior.marginal_precision.double().rsqrt() * scales
    std = (covariance.diagonal().clamp(min=0) + outline_shift.square()).sqrt() * scales
    return Uncertainty(tuple(variables.names), tuple(std.minimum(expected).tolist()), tuple(expected.tolist()))


_SQUARES = torch.logspace(-3, 2, 241, dtype=torch.float64)
"""Squared scales over which `expected_scale` integrates, in steps of 5 % [1]."""
_SHOWN = 1e-4
"""Minimum information of a direction that is used for the scale, in units of the prior's precision [1]."""


def expected_scale(
    moved: Float[Tensor, " n"], information: Float[Tensor, "n n"], prior: Float[Tensor, "n n"], start_share: float = 0.0
) -> float:
    """Estimated ratio of the start's errors to the prior standard deviation, from the corrections of a fit [1].

    Hierarchical prior (Gelman et al., Bayesian Data Analysis, 2013, chapter 5): the square of the scale is lognormal
    with mean 1 and a standard deviation of 1 of its logarithm, and corrections are Gaussian in each direction for a
    given scale. The result is the root of the posterior mean of the square, and 1 if the image determines no direction.

    Args:
        information: curvature of the image term of the objective.
        prior: precision of the offsets before the image was used.
    """
    root = torch.linalg.cholesky(torch.linalg.inv(prior.double()))
    shown, axes = torch.linalg.eigh(root.T @ information.double() @ root)
    corrected = axes.T @ torch.linalg.solve_triangular(root, moved.double()[:, None], upper=False)
    shown, corrected = shown[shown > _SHOWN], corrected[shown > _SHOWN, 0]
    if not len(shown):
        return 1.0
    squares = _SQUARES.to(shown.device)
    variance = squares[:, None] * ((1.0 - start_share) * shown / (1.0 + shown)).square()
    variance += shown / (1.0 + shown).square()
    likelihood = -0.5 * (variance.log() + corrected.square() / variance).sum(1)
    probability = (likelihood - 0.5 * (squares.log() + 0.5).square()).softmax(0)
    return float(probability @ squares) ** 0.5


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of the objective at one point. Maps are at the resolution of comparison, without autograd."""

    value: float
    """Sum of all factors, the prior included."""
    loss: float
    """Loss per arm pixel, without the prior; comparable within one observation and, unless the problem is live, one
    blur."""
    stage_loss: float
    """Loss evaluated with the blur of the current descent."""
    gradient: Float[Tensor, " n"]
    """Gradient of `value`; zero if not requested."""
    hessian: Float[Tensor, "n n"] | None
    """Gauss-Newton approximation of the Hessian of `value`; None if not available."""
    uncertainty: Uncertainty | None
    """Standard deviations from the Hessian, under the prior of the problem; at the end of a fit, under the rescaled
    prior."""
    image: Float[Tensor, "cameras 3 h w"]
    """Rendered arms, RGB, black elsewhere."""
    silhouette: Float[Tensor, "cameras h w"]
    similarity: Float[Tensor, "cameras h w"]
    """Similarity per pixel, at most 1; 1 where nothing was compared."""
    attention: Float[Tensor, "cameras h w"]
    """Weight of each pixel, in [0, 1]."""
    outline_gradient: Float[Tensor, " n"] | None = field(default=None, kw_only=True)
    """Change of `gradient` for one standard deviation of an error common to all outlines; None without a Hessian."""
