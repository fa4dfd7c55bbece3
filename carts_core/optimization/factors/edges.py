"""The last pixel: outlines are drawn to the edges of the image that are near them.

The network knows what an instrument is, but not to a pixel where it ends; the image often does. For every pixel
of an outline the strongest edge along its normal is found, as in RAPiD (Harris and Stennett, 1990) and the trackers
after it. Whether that edge is the right one nobody says, so a robust weight keeps those far away from pulling.
"""

import math
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from ...imaging.edges_numba import nearest_edges
from ...imaging.haze import certainty, dehazed, transmission
from ...model.scene import Scene
from ...rendering import Outline, Renderer
from ...threads import total
from ..inputs import pixel_weights, smoothed, stacked_images, working_size
from ..losses import attention
from ..variables import APART, Variables
from .base import Linearization

_SCALE = 2.0
"""How many times larger than the working image that is in which edges are looked for, up to the camera's image [1]."""

_REACH, _SAMPLING = 4.0, 0.5
"""How far from an outline edges are looked for, and how densely [px]."""

_LIKELY = 3.0
"""Deviation of how far from the outline the right edge is expected [px]."""

_NEAR = 8
"""How near an outline the network has to see an arm [px]."""

_ROBUST = 1.5
"""Distance at which an edge has lost three quarters of its weight [px]."""

_BLUR = 1.0
"""Deviation of the blur under which edges are looked for [px]."""

_SHARE = (0.3, 1.0, 1.0)
"""How much a pixel of the outline counts, per part. Along a straight shaft the errors of many pixels are the same."""

_RENDERED_ANEW = 1.0
"""Outlines that have moved by more than this are rendered again; up to there they move by their Jacobian [px]."""


class EdgeFactor:
    """Half the weighted squared distances of outlines to edges of the images.

    Args:
        scene: with the cameras that take part.
        images: camera name -> observed RGB image.
        variables: the unknowns.
        ignore: camera name -> pixels that show an occluder.
        working_width: of the working image [px].
        dehaze: share of smoke and haze that is taken off [1].
        device: where to compute.

    Raises:
        SettingsError: an image is missing, or an image or a mask is of another size than its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        variables: Variables,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        *,
        working_width: int,
        dehaze: float,
        device: torch.device,
    ) -> None:
        self.variables = variables
        size = working_size(scene, round(working_width * _SCALE), 1)
        stacked = stacked_images(scene, images, size, "image").to(device)
        through = transmission(stacked, dehaze)
        clear = dehazed(stacked, through)
        down, right = torch.gradient(smoothed(clear, _BLUR), dim=(-2, -1))
        # The compiled kernel reads all colours of a pixel at once.
        self._gradient = torch.cat([right, down], 1).contiguous(memory_format=torch.channels_last)
        # An outline beside an occluder would find the occluder's edge.
        hidden = 1.0 - pixel_weights(scene, ignore, size).to(device)
        self._shown = (1.0 - attention(hidden, math.ceil(_REACH))) * certainty(through)
        self.renderer = Renderer(scene, width=size[0], height=size[1], device=device)
        self._scale = 2.0 / (torch.tensor(size, device=device)[:, None] - 1.0)
        self._samples = torch.arange(-_REACH, _REACH + 0.5 * _SAMPLING, _SAMPLING, device=device)
        self._expected = torch.exp(-0.5 * (self._samples / _LIKELY).square())
        self._share = torch.tensor(_SHARE, device=device)

    def near(
        self, offsets: Float[Tensor, " n"], coverage: Float[Tensor, "cameras rows columns"], weight: float
    ) -> "LocalEdgeFactor":
        """The factor in the neighbourhood of a point.

        Args:
            offsets: the point.
            coverage: of the arms as they were observed, of the whole image at any size; other edges do not count.
            weight: of a squared distance, per pixel of the outline [1/px^2].
        """
        near = functional.interpolate(coverage[:, None], self._shown.shape[2:], mode="bilinear").clamp(0.0, 1.0)
        return LocalEdgeFactor(self, offsets, attention(near, _NEAR) * self._shown, weight)

    def equations(self, outline: Outline, counts: Float[Tensor, "cameras 1 h w"], edge_weight: float) -> Linearization:
        """The quadratic model of outlines as they are, where pixels of the images count that much."""
        distance, weight = self._nearest(outline)
        column, row = outline.position.round().long()
        weight = weight * counts[outline.camera, 0, row, column] * self._share[outline.parts]
        weight = weight / (1.0 + (distance / _ROBUST).square()).square()
        weighted = edge_weight * weight * outline.motion
        cost = 0.5 * edge_weight * float((weight * distance.square()).sum())
        return Linearization(cost, -weighted @ distance, weighted @ outline.motion.T)

    def cost(self, outline: Outline, counts: Float[Tensor, "cameras 1 h w"]) -> float:
        """How far outlines are from edges: robust squared distances, summed [px^2].

        A pixel without an edge costs as much as one far away, so that poses compare.
        """
        distance, found = self._nearest(outline)
        column, row = outline.position.round().long()
        weight = counts[outline.camera, 0, row, column] * self._share[outline.parts]
        squared = distance.square() / (1.0 + (distance / _ROBUST).square())
        return total(weight * (found * squared + (1.0 - found) * _ROBUST**2))

    def _nearest(self, outline: Outline) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
        """Distance to the edge along the outward normal [px], and 1 where there is one, 0 elsewhere."""
        if self._gradient.device.type != "cpu":
            return self._nearest_torch(outline)
        values = outline.camera, outline.position, outline.normal, self._samples, self._expected
        near = nearest_edges(
            self._gradient.permute(0, 2, 3, 1).contiguous().numpy(), *(value.contiguous().numpy() for value in values)
        )
        return torch.from_numpy(near[0]), torch.from_numpy(near[1])

    def _nearest_torch(self, outline: Outline) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
        """The same without the compiled kernel, for any device."""
        strength = self._strength(outline) * self._expected[:, None]
        best, last = strength.argmax(0), len(self._samples) - 1
        middle = best.clamp(1, last - 1)
        before, peak, after = (strength.gather(0, (middle + d)[None])[0] for d in (-1, 0, 1))
        finer = 0.5 * (after - before) / (2.0 * peak - before - after).clamp(min=1e-12)
        # The strongest one at either end is the flank of an edge further away.
        found = (best > 0) & (best < last)
        return self._samples[middle] + _SAMPLING * finer.clamp(-0.5, 0.5), found.to(strength)

    def _strength(self, outline: Outline) -> Float[Tensor, "samples K"]:
        """Squared change of colour along the normal."""
        where = outline.position[:, None] + outline.normal[:, None] * self._samples[:, None]
        grid = (where * self._scale[..., None] - 1.0).movedim(0, -1)
        strength = torch.zeros_like(where[0])
        for index, gradient in enumerate(self._gradient):
            here = outline.camera == index
            right, down = functional.grid_sample(gradient[None], grid[:, here][None], align_corners=True)[0].split(3)
            normal = outline.normal[:, here]
            strength[:, here] = (right * normal[0] + down * normal[1]).square().sum(0)
        return strength


class LocalEdgeFactor:
    """Edges near a point. Implements `Factor.linearize`.

    Outlines that move little are moved by their Jacobian; rendering them again is what costs time.
    """

    def __init__(self, factor: EdgeFactor, offsets: Float[Tensor, " n"], counts: Tensor, weight: float) -> None:
        self._factor, self._counts, self._weight = factor, counts, weight
        self._tangents = factor.renderer.tangents(factor.variables.around(offsets), APART)
        self._render(offsets)

    def _render(self, offsets: Tensor) -> None:
        state = self._factor.variables.state(offsets)
        self._outline, self._rendered_at = self._factor.renderer.outline(state, self._tangents), offsets

    def linearize(self, offsets: Float[Tensor, " n"]) -> Linearization:
        """The quadratic model around a point."""
        if self._outline.moved_by(offsets - self._rendered_at) > _RENDERED_ANEW:
            self._render(offsets)
        return self._factor.equations(self._outline.at(offsets - self._rendered_at), self._counts, self._weight)

    def cost(self) -> float:
        """How far the outlines that were rendered last are from edges; see `EdgeFactor.cost`."""
        return self._factor.cost(self._outline, self._counts)

    def moved_by(self, step: Float[Tensor, " n"]) -> float:
        """How far outlines move with a step [px]."""
        return self._outline.moved_by(step)
