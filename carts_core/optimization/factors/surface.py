"""Surface factor: differences between rendered and predicted surface maps, under one blur.

The renderer computes the quantities predicted by the network (parts and normals, see `carts_core.model.parts`) exactly
for any state, so steps need no background, shading or network, and residuals have a Jacobian. A robust weight per pixel
limits the influence of outliers (an occluder, a false detection).
"""

import math
from dataclasses import astuple, dataclass
from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ...imaging.working_image import Window, kernel_radius, smoothed
from ...model.parts import COVERAGE, NORMALS, SURFACE_CHANNELS
from ...model.scene import Scene, SceneState
from ...rendering import JacobianBlock, Renderer, SurfaceRendering
from ...settings import SurfaceSolver
from ...settings.stages import Descend
from ...threads import one_thread, total
from ..observation import Observation
from ..variables import APART, Variables
from .base import Linearization

_REDUCTIONS = (1, 2, 4, 8)
"""Allowed reductions of the observed images in a factor [1]."""

_PIXELS_AT_ONCE = 1 << 20
"""Largest number of pixels, over all states, that are rendered at once."""

_SMALLEST_BLUR = 1.2
"""Smallest blur after reduction of the images [px of the reduced image]."""


class SurfaceFactor:
    """Half the sum of robust squared differences of surface maps, in units of the noise. Implements `Factor`.

    Args:
        stage: blur, and scale of the robust weights.

    Attributes:
        noise: standard deviation of the observation, per pixel [1].
        area: area of a pixel [px of the working image].
        size: width and height of the compared images [px].
        window: the compared part of the images [px].
        certainty: information of a pixel, relative to a clear image [1].
    """

    def __init__(
        self,
        scene: Scene,
        variables: Variables,
        observation: Observation,
        settings: SurfaceSolver,
        stage: Descend,
    ) -> None:
        images = observation.images
        blur = stage.blur * images.scale
        reduction = max(r for r in _REDUCTIONS if r == 1 or blur / r >= _SMALLEST_BLUR)
        self._variables, self._blur, self._robust = variables, blur / reduction, stage.robust
        self.area = (reduction / images.scale) ** 2
        self.noise = settings.mask_noise if observation.masked else settings.noise
        self._precision = self.area / self.noise**2
        self.size = images.size[0] // reduction, images.size[1] // reduction
        self.window = observation.window.reduced(reduction)
        device = observation.maps.device
        self.renderer = Renderer(
            scene, width=self.size[0], height=self.size[1], window=astuple(self.window), device=device
        )
        self._weight = functional.avg_pool2d(observation.weight, reduction)
        self.certainty = functional.avg_pool2d(observation.certainty, reduction)
        self._total_only = not observation.knows_parts
        self._observed = self._blurred(functional.avg_pool2d(observation.maps * observation.weight, reduction))
        self._channels = torch.ones(SURFACE_CHANNELS, 1, 1, device=device)
        self._channels[1 : COVERAGE.stop] = settings.parts_weight
        self._channels[NORMALS] = settings.normals_weight
        # Parts and normals are predicted by the network even where coverage comes from a given mask.
        self._channels[1:] *= (self.noise / settings.noise) ** 2
        if self._total_only:
            self._channels = self._channels[: COVERAGE.start + 1]

    def costs(self, offsets: Float[Tensor, "batch n"]) -> Float[Tensor, " batch"]:
        """Costs of a batch of points, in chunks that fit in memory."""
        states = self._variables.state(offsets)
        pixels = self.window.area * states.intrinsics.shape[-2]
        at_once = max(_PIXELS_AT_ONCE // pixels, 1)
        found = []
        for first in range(0, len(states.intrinsics), at_once):
            part = states.map(lambda values, first=first: values[first : first + at_once])
            _, squared, ratio = self._difference(self.renderer.surface_maps(part))
            with one_thread():
                sums = (squared * ratio * self.certainty).flatten(1).sum(1)
            found.append(0.5 * self.area * sums)
        return torch.cat(found) / self.noise**2

    def compare(self, offsets: Float[Tensor, " n"]) -> "Comparison":
        """Compare the state at a point with the observation."""
        rendering = self.renderer.surface(self._variables.state(offsets), None, 1)
        _, squared, ratio = self._difference(rendering.maps)
        return self._comparison(rendering, squared, ratio)

    def linearize(self, offsets: Float[Tensor, " n"]) -> "SurfaceLinearization":
        """The quadratic model around a point, and the comparison there."""
        around: SceneState = self._variables.around(offsets)
        rendering = self.renderer.surface(around, APART, 1 + kernel_radius(self._blur))
        model, squared, ratio = self._difference(rendering.maps)
        comparison = self._comparison(rendering, squared, ratio)
        residual = self._observed - model
        weight = ratio.square() * self._channels * self._precision * self.certainty
        grown = torch.zeros_like(residual)
        # Increase of coverage if outlines move outwards by one pixel.
        down, right = torch.gradient(model[:, COVERAGE.start], dim=(-2, -1))
        grown[:, COVERAGE.start] = torch.hypot(down, right) / math.sqrt(self.area)
        gradient, hessian, outline = self._normal_equations(
            rendering.jacobian, residual, grown, weight, len(self._variables)
        )
        return SurfaceLinearization(comparison.pixels / self.noise**2, gradient, hessian, comparison, outline)

    def _comparison(self, rendering: SurfaceRendering, squared: Tensor, ratio: Tensor) -> "Comparison":
        return Comparison(
            0.5 * self.area * total(squared * ratio * self.certainty),
            rendering,
            (1.0 - squared[:, 0]).clamp(min=-1.0),
            (ratio.square() * self._weight * self.certainty)[:, 0],
        )

    def _difference(self, maps: Float[Tensor, "*batch cameras 6 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """Blurred maps, squared residuals of pixels, and robust weights in (0, 1]."""
        model = self._blurred(maps * self._weight)
        squared = ((self._observed - model).square() * self._channels).sum(-3, keepdim=True)
        # Geman-McClure: the cost of residuals far beyond the scale saturates, and their gradient vanishes.
        return model, squared, 1.0 / (1.0 + squared / self._robust**2)

    def _blurred(self, maps: Float[Tensor, "*batch 6 h w"]) -> Float[Tensor, "*batch channels h w"]:
        """Blurred channels to compare: all, or only the total coverage if the parts are unknown."""
        if self._total_only:
            return smoothed(maps[..., COVERAGE, :, :].sum(-3, keepdim=True), self._blur)
        blurred = smoothed(maps, self._blur)
        # The total coverage is compared in place of the first part's coverage.
        blurred[..., COVERAGE.start, :, :] = blurred[..., COVERAGE, :, :].sum(-3)
        return blurred

    def _normal_equations(
        self, jacobian: tuple[JacobianBlock, ...], residual: Tensor, grown: Tensor, weight: Tensor, unknowns: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Normal equations -J^T W r, J^T W J and J^T W g, under the blur."""
        gradient, curvature = residual.new_zeros(unknowns), residual.new_zeros(unknowns, unknowns)
        outline = torch.zeros_like(gradient)
        windows, blocks = [], []
        for block in jacobian:
            rows, columns = block.values.shape[-2:]
            window = Window(block.left, block.top, columns, rows)
            values = self._blurred(block.values * window.of(self._weight))
            weighted = (values * window.of(weight)).flatten(1)
            gradient[block.unknowns] = -weighted @ window.of(residual).flatten()
            outline[block.unknowns] = weighted @ window.of(grown).flatten()
            curvature[block.unknowns[:, None], block.unknowns] = weighted @ values.flatten(1).T
            windows.append(window)
            blocks.append((block.unknowns, values))
        for (a, (mine, first)), (b, (others, second)) in combinations(zip(windows, blocks, strict=True), 2):
            common = a.common(b)
            if common is None:
                continue
            ours = (common.inside(a).of(first) * common.of(weight)).flatten(1)
            cross = ours @ common.inside(b).of(second).flatten(1).T
            curvature[mine[:, None], others] = cross
            curvature[others[:, None], mine] = cross.T
        return gradient, curvature, outline


@dataclass(frozen=True)
class Comparison:
    """Comparison of a state with an observation."""

    pixels: float
    """Cost [px of the working image]: half the weighted sum of robust squared residuals."""
    rendering: SurfaceRendering
    similarity: Float[Tensor, "cameras h w"]
    trust: Float[Tensor, "cameras h w"]
    """Weight of each pixel, in [0, 1]."""


@dataclass(frozen=True)
class SurfaceLinearization(Linearization):
    """Quadratic model, and the comparison from which it was computed."""

    comparison: Comparison
    outline: Float[Tensor, " n"]
    """Decrease of the gradient if all observed outlines move outwards by one pixel of the working image [1/px]."""
