"""Hybrid images: what the camera would see if the robot stood where the rendering says."""

from jaxtyping import Float
from torch import Tensor


def hybrid(
    rendering_image: Float[Tensor, "*batch 3 h w"],
    silhouette: Float[Tensor, "*batch h w"],
    background: Float[Tensor, "*#batch 3 h w"],
) -> Float[Tensor, "*batch 3 h w"]:
    """BG_m + Î of the paper: the rendering where the silhouette is, the mean background elsewhere.

    Differentiable in all three; at a silhouette between 0 and 1 the two are blended.

    Args:
        rendering_image: rendered arms, RGB in [0, 1], anything outside the silhouette.
        silhouette: Ŝ in [0, 1].
        background: mean background BG_m, RGB in [0, 1]; it may lack the leading dimensions.
    """
    coverage = silhouette.unsqueeze(-3)
    return background + coverage * (rendering_image - background)
