"""The gradient that a hard visibility image lacks: how everything that is seen moves in the image.

The visible triangle of a pixel is constant almost everywhere, so a rasterized image only changes where surfaces
change their shading; that boundaries (and the shading itself) *move* has to be put in. For two adjacent pixels a and b
let x be the projected surface point of the nearer of them, moving with its triangle. When x moves along the axis from
a to b, the image moves with it: both pixels change by ``(I_a - I_b) / 2`` per pixel of motion. Horizontal pairs carry
motion in x, vertical pairs motion in y; background stands still. Summed over the image this is a summation by parts of
``integral of grad(w) . x' I``, the exact derivative of a weighted image that is transported by x', whatever happens
at occlusion boundaries, where the tangent plane contains the viewing ray and so the contour moves with the surface.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor


class _CarryMotion(torch.autograd.Function):
    """Identity on the image whose backward sends the image's gradient to the moving points as well."""

    @staticmethod
    def forward(ctx, image: Tensor, positions: Tensor, pixels: Tensor, inverse_depth: Tensor) -> Tensor:
        ctx.save_for_backward(image, pixels, inverse_depth)
        return image.view_as(image)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        (gradient,) = gradients
        image, pixels, inverse_depth = ctx.saved_tensors
        moving = image.new_zeros(*inverse_depth.shape, 2)
        for axis, dim in ((0, 2), (1, 1)):
            length = image.shape[dim] - 1
            first, second = _halves(image, dim, length)
            gradient_first, gradient_second = _halves(gradient, dim, length)
            share = -0.5 * ((second - first) * (gradient_first + gradient_second)).sum(-1)
            z_first, z_second = _halves(inverse_depth, dim, length)
            first_is_near = z_first >= z_second
            moving.narrow(dim, 0, length)[..., axis] += share * first_is_near
            moving.narrow(dim, 1, length)[..., axis] += share * ~first_is_near
        return gradient, moving.view(-1, 2)[pixels], None, None


def _halves(image: Tensor, dim: int, length: int) -> tuple[Tensor, Tensor]:
    return image.narrow(dim, 0, length), image.narrow(dim, 1, length)


def carry_motion(
    image: Float[Tensor, "views height width channels"],
    positions: Float[Tensor, "K 2"],
    pixels: Int[Tensor, " K"],
    inverse_depth: Float[Tensor, "views height width"],
) -> Float[Tensor, "views height width channels"]:
    """The image, unchanged in value, moving with its visible points.

    Args:
        image: rendered channels, which may carry gradients of their own (shading).
        positions: projected surface point of every visible pixel [px], with gradient.
        pixels: index of these pixels in the flattened `views x height x width`.
        inverse_depth: 1 / depth [1/m], 0 for background.
    """
    return _CarryMotion.apply(image, positions, pixels, inverse_depth)
