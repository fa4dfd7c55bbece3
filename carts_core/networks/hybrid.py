"""Hybrid images: what the camera would see if the robot stood where the rendering says."""

from jaxtyping import Float
from torch import Tensor


def hybrid(
    rendering_image: Float[Tensor, "*batch 3 h w"],
    silhouette: Float[Tensor, "*batch h w"],
    background: Float[Tensor, "*#batch 3 h w"],
) -> Float[Tensor, "*batch 3 h w"]:
    """BG_m + Î of the paper: the rendering where the silhouette is, the mean background elsewhere.

    The rendering is black outside the silhouette, so the background only has to make room for it; at a silhouette
    between 0 and 1 (blurred, or moving in a gradient) the two add up to what a lens would mix.

    Args:
        rendering_image: rendered arms, RGB in [0, 1], black where the silhouette is 0.
        silhouette: Ŝ in [0, 1].
        background: mean background BG_m, RGB in [0, 1]; it may lack the leading dimensions.
    """
    return background * (1.0 - silhouette.unsqueeze(-3)) + rendering_image
