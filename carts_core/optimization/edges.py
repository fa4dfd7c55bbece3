"""The last pixel: outlines are drawn to the edges of the image that are near them.

The network knows what an instrument is, but not to a pixel where it ends; the image often does. Every pixel of an
outline looks along its normal for the strongest edge and is drawn there, as in RAPiD (Harris and Stennett, 1990) and
the trackers after it. Whether that edge is the right one nobody says, so a robust weight keeps those far away from
pulling, and what the network saw goes on counting.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from ..losses import attention
from ..rendering import Outline, Renderer, Tangents
from ..scene import Scene
from ..settings import OptimizerSettings
from .inputs import pixel_weights, smoothed, stacked_images, working_size
from .parameters import APART, ParameterVector
from .veil import certainty, transmission, unveiled

_ZOOM = 2.0
"""How many times larger than the working image that is in which edges are looked for, up to the camera's image [1]."""

_REACH, _SAMPLING = 4.0, 0.5
"""How far from an outline edges are looked for, and how densely [px]."""

_LIKELY = 3.0
"""Deviation of how far from the outline the right edge is expected [px]."""

_NEAR = 8
"""How near an outline the network has to see an arm [px]."""

_ROBUST = 1.5
"""Distance beyond which an edge is not believed [px]."""

_BLUR = 1.0
"""Deviation of the blur under which edges are looked for [px]."""

_SHARE = (0.3, 1.0, 1.0)
"""How much a pixel of the outline counts, per part. Along a straight shaft the errors of many pixels are the same."""

_LONGEST_STEP = 0.05
"""Largest change of an unknown in one step [rad]; edges are near, so a longer one is a mistake."""

_RENDERED_ANEW = 1.0
"""Outlines that have moved by more than this are rendered anew; up to there they move as they say they do [px]."""

_STILL = 0.03
"""Outlines that move by no more than this have arrived [px]."""


@dataclass(frozen=True)
class Drawn:
    """Outlines on edges."""

    offsets: Float[Tensor, " n"]
    gradient: Float[Tensor, " n"]
    """Of what edges say there, by the linear model."""
    curvature: Float[Tensor, "n n"]
    """The same."""


class EdgeRefinement:
    """Draws outlines to edges.

    Args:
        scene: with the cameras that take part.
        images: camera name -> observed RGB image.
        parameters: the unknowns.
        settings: how many steps, and how much edges count.
        ignore: camera name -> pixels that show an occluder.
        device: where to compute.

    Raises:
        SettingsError: an image is missing, or an image or a mask is of another size than its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        parameters: ParameterVector,
        settings: OptimizerSettings,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        device: torch.device,
    ) -> None:
        self._parameters, self._settings = parameters, settings
        size = working_size(scene, round(settings.working_width * _ZOOM), 1)
        stacked = stacked_images(scene, images, size, "image").to(device)
        through = transmission(stacked, settings.unveil)
        clear = unveiled(stacked, through)
        down, right = torch.gradient(smoothed(clear, _BLUR), dim=(-2, -1))
        self._gradient = torch.cat([right, down], 1)
        # An outline beside an occluder would find the occluder's edge.
        hidden = 1.0 - pixel_weights(scene, ignore, size).to(device)
        self._shown = (1.0 - attention(hidden, math.ceil(_REACH))) * certainty(through)
        self._renderer = Renderer(scene, width=size[0], height=size[1], device=device)
        self._scale = 2.0 / (torch.tensor(size, device=device)[:, None] - 1.0)
        self._samples = torch.arange(-_REACH, _REACH + 0.5 * _SAMPLING, _SAMPLING, device=device)
        self._expected = torch.exp(-0.5 * (self._samples / _LIKELY).square())
        self._share = torch.tensor(_SHARE, device=device)

    @torch.no_grad()
    def __call__(
        self,
        offsets: Float[Tensor, " n"],
        gradient: Float[Tensor, " n"],
        curvature: Float[Tensor, "n n"],
        seen: Float[Tensor, "cameras rows columns"],
    ) -> Drawn:
        """Draw the outlines to edges, as far as what else is known agrees.

        Args:
            offsets: where to begin.
            gradient, curvature: of the objective there; they stand for all that is known but for edges.
            seen: coverage of arms as the network saw it, of the whole image at any size; other edges do not count.
        """
        near = functional.interpolate(seen[:, None], self._shown.shape[2:], mode="bilinear").clamp(0.0, 1.0)
        counts = attention(near, _NEAR) * self._shown
        origin, step = offsets, torch.zeros_like(offsets)
        slope, stiffness = torch.zeros_like(gradient), torch.zeros_like(curvature)
        tangents = self._renderer.tangents(self._parameters.around(origin), APART)
        outline, rendered_at = self._rendered(offsets, tangents), offsets
        for _ in range(self._settings.edge_steps):
            if outline.moved_by(offsets - rendered_at) > _RENDERED_ANEW:
                outline, rendered_at = self._rendered(offsets, tangents), offsets
            slope, stiffness = self._equations(outline.at(offsets - rendered_at), counts)
            before = offsets
            total = gradient + curvature @ (before - origin) + slope
            offsets = self._parameters.clamp(before + self._step(before, total, curvature + stiffness))
            step = offsets - before
            if outline.moved_by(step) < _STILL:
                break
        return Drawn(offsets, slope + stiffness @ step, stiffness)

    def _rendered(self, offsets: Tensor, tangents: Tangents) -> Outline:
        return self._renderer.outline(self._parameters.state(offsets), tangents)

    def _step(self, offsets: Tensor, gradient: Tensor, curvature: Tensor) -> Tensor:
        """Where the linear model is lowest; what is at a limit and would go beyond it stays there."""
        lower, upper = self._parameters.lower, self._parameters.upper
        free = ~(((offsets <= lower) & (gradient > 0)) | ((offsets >= upper) & (gradient < 0)))
        step = torch.zeros_like(offsets)
        step[free] = torch.linalg.solve(curvature[free][:, free].double(), -gradient[free].double()).to(step)
        return step * min(1.0, _LONGEST_STEP / float(step.abs().max().clamp(min=1e-12)))

    def _equations(self, outline: Outline, counts: Float[Tensor, "cameras 1 h w"]) -> tuple[Tensor, Tensor]:
        """Gradient [n] and curvature [n, n] of half the weighted squared distances of outlines to edges."""
        distance, weight = self._nearest(outline)
        column, row = outline.position.round().long()
        weight = weight * counts[outline.camera, 0, row, column] * self._share[outline.parts]
        believed = weight / (1.0 + (distance / _ROBUST).square()).square()
        weighted = self._settings.edge_weight * believed * outline.motion
        return -weighted @ distance, weighted @ outline.motion.T

    def _nearest(self, outline: Outline) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
        """Distance to the edge along the outward normal [px], and 1 where there is one, 0 elsewhere."""
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
