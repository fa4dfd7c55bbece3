"""A problem evaluated at one point: the objective, its quadratic model, and the rendered images."""

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Tensor

from .factors import Prior
from .observability import Uncertainty, uncertainty_after
from .variables import Variables


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
