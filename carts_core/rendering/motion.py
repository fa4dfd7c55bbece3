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
        height, width = inverse_depth.shape[1:]
        flat_image, flat_gradient = image.flatten(1), gradient.flatten(1)
        nearness = inverse_depth.flatten()
        here_image, here_gradient, here_near = flat_image[:, pixels], flat_gradient[:, pixels], nearness[pixels]
        column, row = pixels % width, pixels // width % height
        moving = image.new_zeros(2, len(pixels))
        for axis, step, position, length in ((0, 1, column, width), (1, width, row, height)):
            for sign in (1, -1):
                exists = position < length - 1 if sign > 0 else position > 0
                # A pixel at the image's border is its own neighbour, which adds nothing.
                other = torch.where(exists, pixels + sign * step, pixels)
                # Of two equally near points the first one carries the motion.
                near = here_near >= nearness[other] if sign > 0 else here_near > nearness[other]
                change = (flat_image[:, other] - here_image) * (flat_gradient[:, other] + here_gradient)
                moving[axis] -= 0.5 * sign * change.sum(0) * near
        return gradient, moving, None, None


def carry_motion(
    image: Float[Tensor, "channels views height width"],
    positions: Float[Tensor, "2 K"],
    pixels: Int[Tensor, " K"],
    inverse_depth: Float[Tensor, "views height width"],
) -> Float[Tensor, "channels views height width"]:
    """The image, unchanged in value, moving with its visible points.

    Args:
        image: rendered channels, which may carry gradients of their own (shading).
        positions: projected surface point of every visible pixel [px], with gradient.
        pixels: index of these pixels in the flattened `views x height x width`.
        inverse_depth: 1 / depth [1/m], 0 for background.
    """
    return _CarryMotion.apply(image, positions, pixels, inverse_depth)  # pyright: ignore[reportReturnType]
