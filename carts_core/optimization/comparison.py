"""Two surface maps under one blur: how much they differ, and how the difference changes with the unknowns."""

import math
from dataclasses import astuple, dataclass, replace
from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ..rendering import JacobianBlock, Renderer, SurfaceRendering
from ..scene import Scene, SceneState
from ..settings import OptimizerSettings
from ..surface import COVERAGE, NORMALS, SURFACE_CHANNELS
from ..threads import one_thread, total
from .inputs import kernel_radius, smoothed
from .parameters import APART
from .window import Window

_FACTORS = (1, 2, 4, 8)
"""How many times smaller than the compared images those of a stage can be."""

_STATES_AT_ONCE, _PIXELS_AT_ONCE = 128, 1 << 20
"""Most states, and most pixels of all of them, that are rendered at once."""

_SMALLEST_BLUR = 1.2
"""A stage is reduced as far as its blur stays at least this [px of the reduced image]."""


class Stage:
    """The comparison under one blur, at the resolution that the blur leaves."""

    def __init__(
        self,
        scene: Scene,
        size: tuple[int, int],
        zoom: float,
        window: Window,
        observed: Float[Tensor, "cameras 6 h w"],
        weight: Float[Tensor, "cameras 1 h w"],
        certainty: Float[Tensor, "cameras 1 h w"],
        blur: float,
        settings: OptimizerSettings,
    ) -> None:
        blur *= zoom
        factor = max(f for f in _FACTORS if f == 1 or blur / f >= _SMALLEST_BLUR)
        self._blur, self._robust = blur / factor, settings.robust
        self.area = (factor / zoom) ** 2
        """Of a pixel [px of the working image]."""
        self._precision = self.area / settings.noise**2
        self.size = size[0] // factor, size[1] // factor
        self.window = window.reduced(factor)
        self.renderer = Renderer(
            scene, width=self.size[0], height=self.size[1], window=astuple(self.window), device=observed.device
        )
        self._weight = functional.avg_pool2d(weight, factor)
        self.certainty = functional.avg_pool2d(certainty, factor)
        """What a pixel tells, as a share of what it would tell in a clear image [1]."""
        maps = functional.avg_pool2d(observed * weight, factor)
        self._observed = compared(smoothed(maps, self._blur))
        self._channels = torch.ones(SURFACE_CHANNELS, 1, 1, device=maps.device)
        self._channels[1 : COVERAGE.stop] = settings.parts_weight
        self._channels[NORMALS] = settings.normals_weight

    def costs(self, states: SceneState) -> Float[Tensor, " batch"]:
        """Of a batch of states, as many at once as memory allows; see `Comparison.cost`."""
        pixels = self.window.area * states.intrinsics.shape[-2]
        at_once = max(min(_STATES_AT_ONCE, _PIXELS_AT_ONCE // pixels), 1)
        found = []
        for first in range(0, len(states.intrinsics), at_once):
            part = states.map(lambda values, first=first: values[first : first + at_once])
            _, squared, ratio = self._difference(self.renderer.surface_maps(part))
            with one_thread():
                sums = (squared * ratio * self.certainty).flatten(1).sum(1)
            found.append(0.5 * self.area * sums)
        return torch.cat(found)

    def compare(self, state: SceneState, *, gradient: bool) -> "Comparison":
        """Compare a state; with a gradient, also say how the cost changes.

        Args:
            state: one state, or with a gradient a batch, as `ParameterVector.around` makes it.
        """
        margin = 1 + kernel_radius(self._blur)
        rendering = self.renderer.surface(state, APART if gradient else None, margin)
        model, squared, ratio = self._difference(rendering.maps)
        comparison = Comparison(
            0.5 * self.area * total(squared * ratio * self.certainty),
            rendering,
            (1.0 - squared[:, 0]).clamp(min=-1.0),
            (ratio.square() * self._weight * self.certainty)[:, 0],
        )
        if not gradient:
            return comparison
        residual = self._observed - model
        weight = ratio.square() * self._channels * self._precision * self.certainty
        grown = torch.zeros_like(residual)
        grown[:, COVERAGE.start] = _growth(model[:, COVERAGE.start]) / math.sqrt(self.area)
        # Half of the states around it are an unknown each.
        unknowns = state.intrinsics.shape[0] // 2
        equations = self._normal_equations(rendering.jacobian, residual, grown, weight, unknowns)
        return replace(comparison, **equations)

    def _difference(self, maps: Float[Tensor, "*batch cameras 6 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """Maps under the blur, the squared residual of each pixel, and what is left of that for being large [1]."""
        model = compared(smoothed(maps * self._weight, self._blur))
        squared = ((self._observed - model).square() * self._channels).sum(-3, keepdim=True)
        # Geman-McClure: a residual far beyond the scale costs no more, and no longer pulls.
        return model, squared, 1.0 / (1.0 + squared / self._robust**2)

    def _normal_equations(
        self, jacobian: tuple[JacobianBlock, ...], residual: Tensor, grown: Tensor, weight: Tensor, unknowns: int
    ) -> dict[str, Tensor]:
        """-J^T W r, J^T W J and J^T W g, under the blur."""
        gradient, curvature = residual.new_zeros(unknowns), residual.new_zeros(unknowns, unknowns)
        outline = torch.zeros_like(gradient)
        windows, blocks = [], []
        for block in jacobian:
            rows, columns = block.values.shape[-2:]
            window = Window(block.left, block.top, columns, rows)
            values = compared(smoothed(block.values * window.of(self._weight), self._blur))
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
        return {"gradient": gradient, "curvature": curvature, "outline": outline}


@dataclass(frozen=True)
class Comparison:
    """How a state compares with what is observed, in one stage."""

    cost: float
    """Half the sum of robust squared residuals, each as far as it is believed [px of the working image]."""
    rendering: SurfaceRendering
    similarity: Float[Tensor, "cameras h w"]
    trust: Float[Tensor, "cameras h w"]
    """Weight of each pixel, in [0, 1]."""
    gradient: Float[Tensor, " n"] | None = None
    """Of the cost in units of the noise."""
    curvature: Float[Tensor, "n n"] | None = None
    outline: Float[Tensor, " n"] | None = None
    """What the gradient loses when all observed outlines move outwards by a pixel of the working image [1/px]."""


def _growth(coverage: Float[Tensor, "cameras h w"]) -> Float[Tensor, "cameras h w"]:
    """What coverage gains when outlines move outwards by a pixel."""
    down, right = torch.gradient(coverage, dim=(-2, -1))
    return torch.hypot(down, right)


def compared(maps: Float[Tensor, "*batch 6 h w"]) -> Float[Tensor, "*batch 6 h w"]:
    """Surface maps, in place, with the coverage of all parts in place of the first one's: what a mask is made of."""
    maps[..., COVERAGE.start, :, :] = maps[..., COVERAGE, :, :].sum(-3)
    return maps
