"""A problem evaluated at one point: the objective, its quadratic model, and the rendered images."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from .observability import Uncertainty


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
    """Standard deviations that follow from the hessian."""
    image: Float[Tensor, "cameras 3 h w"]
    """Rendered arms, RGB, black elsewhere."""
    silhouette: Float[Tensor, "cameras h w"]
    similarity: Float[Tensor, "cameras h w"]
    """At most 1; 1 where nothing was compared."""
    attention: Float[Tensor, "cameras h w"]
    """Weight of each pixel, in [0, 1]."""
