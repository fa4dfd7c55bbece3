"""Evaluations of an objective, their standard deviations, and the joints that an image determines."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..settings import SurfaceSolver
from ..wording import counted
from .factors import Prior
from .variables import Variables

if TYPE_CHECKING:
    from ..model.scene import Scene


Observability = Literal["determined", "weak", "not visible"]

_DETERMINED, _VISIBLE = 1 / 3, 0.9
_OPEN_ANGLE = _DETERMINED * math.radians(SurfaceSolver.prior_deg)
_OPEN_LENGTH = _OPEN_ANGLE * SurfaceSolver.length_scale
"""Standard deviations above which a joint is not determined [rad, m]."""


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


def undetermined_joints(
    scene: "Scene", joint_std: Mapping[str, Sequence[float | None] | np.ndarray]
) -> list[str] | None:
    """`ARM.JOINT` of every joint that a fit leaves open: its deviation is above a third of what is expected of a start.

    Args:
        scene: whose arms these are.
        joint_std: arm -> standard deviations [rad, m]; None and NaN (joints that were held) do not count.

    Returns:
        None where no deviation is known.
    """
    known, undetermined = False, []
    for arm in scene.arms:
        named = zip(arm.robot.joint_names, arm.robot.joint_types, joint_std.get(arm.name, ()), strict=False)
        for joint, kind, std in named:
            if std is None or math.isnan(std):
                continue
            known = True
            if std > (_OPEN_LENGTH if kind == "prismatic" else _OPEN_ANGLE):
                undetermined.append(f"{arm.name}.{joint}")
    return undetermined if known else None


def fit_words(verdict: str, undetermined: Sequence[str] | None) -> str:
    """A verdict, which is about the mask, with what is known of the joints: `mask good, 4 joints not determined`.

    Args:
        verdict: good, doubtful or failed.
        undetermined: as from `undetermined_joints`; None where no deviation is known.
    """
    if undetermined is None:
        return f"mask {verdict}"
    joints = f"{counted(len(undetermined), 'joint')} not determined" if undetermined else "all joints determined"
    return f"mask {verdict}, {joints}"


def uncertainty(
    variables: Variables, prior: Prior, curvature: Float[Tensor, "n n"], common: Float[Tensor, " n"]
) -> Uncertainty | None:
    """For errors of the start as large as expected, from the second derivative of an objective in units of its noise.

    Args:
        variables: the unknowns.
        prior: of their offsets, before the image was used.
        curvature: J^T J / noise^2 and the prior's precision, per offset.
        common: what the gradient would be off by for one standard deviation of an error that all pixels share. Pixels
            cannot average it out, so it comes on top of what their noise does, but never above what was expected.

    Returns:
        None where the prior leaves an unknown open.
    """
    if not prior.informs_all:
        return None
    covariance = torch.linalg.inv(curvature.double())
    return _uncertainty(variables, prior, covariance, covariance @ common.double())


def uncertainty_after(
    variables: Variables,
    prior: Prior,
    curvature: Float[Tensor, "n n"],
    common: Float[Tensor, " n"],
    moved: Float[Tensor, " n"],
    start_share: float,
) -> Uncertainty:
    """For errors of the start as large as what a fit has corrected makes likely.

    The fit is the optimum under a prior of the expected size, so more is left of larger errors than its curvature says:
    of an error e of the start, (P + a I) (I + P)^-1 e, where I is the image's information, P the prior's precision and
    a the share of the start in what the network predicts. Noise comes on top of it.

    Args:
        variables: the unknowns.
        prior: of their offsets, before the image was used; it informs all of them.
        curvature: J^T J / noise^2 and the prior's precision, per offset.
        common: as in `uncertainty`.
        moved: offsets at the optimum, less the prior's mean.
        start_share: share of an error of the start that is left in what the image seems to show [1].
    """
    precision, curvature = prior.precision.double(), curvature.double()
    information, inverse = curvature - precision, torch.linalg.inv(curvature)
    scale = expected_scale(moved, information, precision, start_share)
    left = inverse @ (precision + start_share * information)
    covariance = scale**2 * left @ torch.linalg.inv(precision) @ left.T + inverse @ information @ inverse
    return _uncertainty(variables, prior, covariance, inverse @ common.double(), scale)


def _uncertainty(
    variables: Variables, prior: Prior, covariance: Float[Tensor, "n n"], common: Float[Tensor, " n"], scale: float = 1
) -> Uncertainty:
    scales = variables.scales.double()
    expected = scale * prior.marginal_precision.double().rsqrt() * scales
    std = (covariance.diagonal().clamp(min=0) + common.square()).sqrt() * scales
    return Uncertainty(tuple(variables.names), tuple(std.minimum(expected).tolist()), tuple(expected.tolist()))


_SQUARES = torch.logspace(-3, 2, 241, dtype=torch.float64)
"""Squares of the scales that `expected_scale` weighs, in steps of 5 % [1]."""
_SHOWN = 1e-4
"""Directions of which the image tells less, in units of the prior's precision, tell nothing of the scale [1]."""


def expected_scale(
    moved: Float[Tensor, " n"], information: Float[Tensor, "n n"], prior: Float[Tensor, "n n"], start_share: float = 0.0
) -> float:
    """How many times as large as expected the errors of the start probably were, from what a fit has corrected [1].

    Errors of one frame are about as large for joints that it shows as for those that it does not show. The square of
    the scale is lognormal beforehand, of mean 1 and a deviation of 1 of its logarithm; corrections are Gaussian in each
    direction, given the scale. This is the root of the square's mean afterwards (a hierarchical prior; Gelman et al.,
    Bayesian Data Analysis, 2013, chapter 5). An image which determines nothing changes nothing.

    Args:
        moved: offsets at the optimum, less the prior's mean.
        information: curvature of the image's part of the objective.
        prior: inverse covariance of the offsets before the image was used.
        start_share: as in `uncertainty_after`.
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
    """An objective at one point. Maps are at the resolution of comparison, and nothing carries autograd."""

    value: float
    """What is descended: the sum of all factors, the prior included."""
    loss: float
    """Without the prior, per pixel of the arms. Comparable among evaluations of one observation, and unless
    the problem is live under one blur."""
    stage_loss: float
    """The same under the blur that is descended in."""
    gradient: Float[Tensor, " n"]
    """Of `value`; zero if it was not asked for."""
    hessian: Float[Tensor, "n n"] | None
    """Gauss-Newton's approximation of the second derivative of `value`; None where there is none."""
    uncertainty: Uncertainty | None
    """Standard deviations that follow from the hessian, for errors as large as expected."""
    image: Float[Tensor, "cameras 3 h w"]
    """Rendered arms, RGB, black elsewhere."""
    silhouette: Float[Tensor, "cameras h w"]
    similarity: Float[Tensor, "cameras h w"]
    """At most 1; 1 where nothing was compared."""
    attention: Float[Tensor, "cameras h w"]
    """Weight of each pixel, in [0, 1]."""
    common: Float[Tensor, " n"] | None = field(default=None, kw_only=True)
    """What the gradient is off by for one standard deviation of an error that all pixels share; None as the hessian."""

    def final_uncertainty(
        self, offsets: Float[Tensor, " n"], variables: Variables, prior: Prior, start_share: float
    ) -> Uncertainty | None:
        """Deviations where a fit has ended, for errors of the start as large as what it has corrected makes likely.

        Args:
            offsets: where it has ended, near this point.
            variables: the unknowns.
            prior: of their offsets.
            start_share: share of an error of the start that is left in what the image seems to show [1].
        """
        if self.hessian is None or self.common is None or self.uncertainty is None:
            return None
        moved = offsets - prior.mean
        return self.uncertainty.scaled(
            uncertainty_after(variables, prior, self.hessian, self.common, moved, start_share)
        )
