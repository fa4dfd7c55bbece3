"""Factors of one frame: surface maps, and outlines at image edges.

The renderer computes the quantities that the network predicts (parts and normals, see `carts_core.model.parts`) exactly
for any state. Steps therefore need no background, shading or network, and residuals have a Jacobian. A robust weight
per pixel limits the influence of outliers (occluders, false detections).
"""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from ..arrays import as_array
from ..compiled import compiled
from ..imaging.working_image import (
    Window,
    attention,
    certainty,
    dehazed,
    kernel_radius,
    pixel_weights,
    smoothed,
    stacked_images,
    transmission,
    working_size,
)
from ..model.parts import COVERAGE, NORMALS, SURFACE_CHANNELS
from ..model.scene import Scene, SceneState
from ..rendering import JacobianBlock, Outline, Renderer, SurfaceRendering
from ..settings import SurfaceSolver
from ..settings.stages import AlignEdges, Descend
from ..threads import one_thread, total
from .factors import Linearization, bounded_step
from .observation import Observation
from .variables import DIFFERENCE_SPAN, Variables

_REDUCTIONS = (1, 2, 4, 8)
"""Allowed reductions of the observed images in a factor [1]."""

_PIXELS_AT_ONCE = 1 << 20
"""Maximum number of pixels, over all states, that are rendered at once."""

_MIN_BLUR = 1.2
"""Minimum blur after reduction of the images [px of the reduced image]."""


class SurfaceFactor:
    """Half the sum of robust squared differences of surface maps, in units of the noise. Implements `Factor`.

    Args:
        stage: blur, and scale of the robust weights.

    Attributes:
        noise: standard deviation of the observation, per pixel [1].
        area: area of a pixel [px of the working image].
        size: width and height of the compared images [px].
        window: the compared part of the images [px].
        weight: 0 for ignored pixels, 1 for others [1].
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
        reduction = max(r for r in _REDUCTIONS if r == 1 or blur / r >= _MIN_BLUR)
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
        self.weight = functional.avg_pool2d(observation.weight, reduction)
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
        """Quadratic model around a point, and the comparison at the point."""
        around: SceneState = self._variables.around(offsets)
        rendering = self.renderer.surface(around, DIFFERENCE_SPAN, 1 + kernel_radius(self._blur))
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
            (ratio.square() * self.weight * self.certainty)[:, 0],
        )

    def _difference(self, maps: Float[Tensor, "*batch cameras 6 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """Blurred maps, squared residuals of pixels, and robust weights in (0, 1]."""
        model = self._blurred(maps * self.weight)
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

    @one_thread()
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
            values = self._blurred(block.values * window.of(self.weight))
            weighted = (values * window.of(weight)).flatten(1)
            gradient[block.unknowns] = -weighted @ window.of(residual).flatten()
            outline[block.unknowns] = weighted @ window.of(grown).flatten()
            curvature[block.unknowns[:, None], block.unknowns] = weighted @ values.flatten(1).T
            windows.append(window)
            blocks.append((block.unknowns, values))
        for (a, (mine, first)), (b, (others, second)) in combinations(zip(windows, blocks, strict=True), 2):
            common = a.intersection(b)
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


@compiled
def _nearest(gradient, camera, position, normal, samples, expected, sampling, distance, found):
    height, width, channels = gradient.shape[1:]
    half, last = channels // 2, len(samples) - 1
    strength = np.empty(len(samples), np.float32)
    for k in range(len(camera)):
        image = gradient[camera[k]]
        nx, ny = normal[0, k], normal[1, k]
        best = 0
        for s in range(len(samples)):
            x, y = position[0, k] + nx * samples[s], position[1, k] + ny * samples[s]
            # Outside the image the gradient is 0.
            if not (x >= 0.0 and y >= 0.0 and x <= width - 1.0 and y <= height - 1.0):
                strength[s] = 0.0
            else:
                column, row = min(int(x), width - 2), min(int(y), height - 2)
                u, v = x - np.float32(column), y - np.float32(row)
                upper, lower = image[row], image[row + 1]
                squared = np.float32(0.0)
                for c in range(half):
                    right_above = upper[column, c] + u * (upper[column + 1, c] - upper[column, c])
                    right_below = lower[column, c] + u * (lower[column + 1, c] - lower[column, c])
                    d = half + c
                    down_above = upper[column, d] + u * (upper[column + 1, d] - upper[column, d])
                    down_below = lower[column, d] + u * (lower[column + 1, d] - lower[column, d])
                    along = nx * (right_above + v * (right_below - right_above))
                    along += ny * (down_above + v * (down_below - down_above))
                    squared += along * along
                strength[s] = squared * expected[s]
            if strength[s] > strength[best]:
                best = s
        middle = min(max(best, 1), last - 1)
        before, peak, after = strength[middle - 1], strength[middle], strength[middle + 1]
        finer = np.float32(0.5) * (after - before) / max(np.float32(2.0) * peak - before - after, np.float32(1e-12))
        distance[k] = samples[middle] + sampling * min(max(finer, np.float32(-0.5)), np.float32(0.5))
        # A maximum at either end of the search range belongs to a more distant edge.
        found[k] = 1.0 if 0 < best < last else 0.0


def nearest_edges(
    gradient: Float[np.ndarray, "cameras height width 6"],
    camera: Int[np.ndarray, " K"],
    position: Float[np.ndarray, "2 K"],
    normal: Float[np.ndarray, "2 K"],
    samples: Float[np.ndarray, " samples"],
    expected: Float[np.ndarray, " samples"],
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Distance to the strongest edge along the outward normal [px], and 1 if an edge is found, else 0.

    Args:
        gradient: image gradients of the three colour channels, in x and then in y [1/px].
        position: outline points [px].
        samples: evenly spaced search distances along the normal, at least three [px].
        expected: weight of each sample [1].
    """
    distance, found = (np.empty(len(camera), np.float32) for _ in range(2))
    sampling = samples[1] - samples[0]
    _nearest(gradient, camera, position, normal, samples, expected, sampling, distance, found)
    return distance, found


_SCALE = 2.0
"""Size of the image for edge detection relative to the working image, limited to the camera's resolution [1]."""

_REACH, _SAMPLING = 4.0, 0.5
"""Search range along the normal of an outline, and sample spacing [px]."""

_LIKELY = 3.0
"""Standard deviation of the expected distance between outline and true edge [px]."""

_NEAR = 8
"""Maximum distance of an outline from predicted coverage [px]."""

_ROBUST = 1.5
"""Distance at which the weight of an edge is reduced to a quarter [px]."""

_BLUR = 1.0
"""Standard deviation of the blur for edge detection [px]."""

EDGE_SHARE = np.array((0.3, 1.0, 1.0), np.float32)
"""Weight of an outline pixel per part [1]; errors along a straight shaft are correlated over many pixels."""

_RENDERED_ANEW = 1.0
"""Motion beyond which outlines are rendered again; smaller motions use their Jacobian [px]."""


class EdgeFactor:
    """Half the weighted squared distances of outlines to edges of the images.

    Args:
        ignore: camera name -> pixels that show an occluder.

    Raises:
        SettingsError: an image is missing, or the size of an image or mask differs from that of its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        variables: Variables,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        settings: SurfaceSolver,
        device: torch.device,
    ) -> None:
        self.variables = variables
        size = working_size(scene, round(settings.working_width * _SCALE), 1)
        stacked = stacked_images(scene, images, size, "image").to(device)
        through = transmission(stacked, settings.dehaze)
        clear = dehazed(stacked, through)
        down, right = torch.gradient(smoothed(clear, _BLUR), dim=(-2, -1))
        # The compiled kernel reads all colours of a pixel at once.
        self._gradient = torch.cat([right, down], 1).contiguous(memory_format=torch.channels_last)
        # An outline next to an occluder would be matched to the occluder's edge.
        hidden = 1.0 - pixel_weights(scene, ignore, size).to(device)
        self._shown = (1.0 - attention(hidden, math.ceil(_REACH))) * certainty(through)
        self.renderer = Renderer(scene, width=size[0], height=size[1], device=device)
        self._samples = torch.arange(-_REACH, _REACH + 0.5 * _SAMPLING, _SAMPLING, device=device)
        self._expected = torch.exp(-0.5 * (self._samples / _LIKELY).square())
        self._share = torch.from_numpy(EDGE_SHARE).to(device)

    def near(
        self, offsets: Float[Tensor, " n"], coverage: Float[Tensor, "cameras rows columns"], weight: float
    ) -> "LocalEdgeFactor":
        """Local edge factor in the neighbourhood of a point.

        Args:
            coverage: observed coverage of the arms in the whole image, at any resolution; edges farther than `_NEAR`
                from it are ignored.
            weight: weight of a squared distance per outline pixel [1/px^2].
        """
        near = functional.interpolate(coverage[:, None], self._shown.shape[2:], mode="bilinear").clamp(0.0, 1.0)
        return LocalEdgeFactor(self, offsets, attention(near, _NEAR) * self._shown, weight)

    @one_thread()
    def equations(self, outline: Outline, counts: Float[Tensor, "cameras 1 h w"], edge_weight: float) -> Linearization:
        """Quadratic model for given outlines and pixel weights."""
        distance, weight = self._nearest(outline)
        column, row = outline.position.round().long()
        weight = weight * counts[outline.camera, 0, row, column] * self._share[outline.parts]
        weight = weight / (1.0 + (distance / _ROBUST).square()).square()
        weighted = edge_weight * weight * outline.motion
        cost = 0.5 * edge_weight * float((weight * distance.square()).sum())
        return Linearization(cost, -weighted @ distance, weighted @ outline.motion.T)

    def cost(self, outline: Outline, counts: Float[Tensor, "cameras 1 h w"]) -> float:
        """Edge cost of outlines: sum of robust squared distances [px^2].

        An outline pixel without an edge has the cost of a distant edge, so that costs of poses are comparable.
        """
        distance, found = self._nearest(outline)
        column, row = outline.position.round().long()
        weight = counts[outline.camera, 0, row, column] * self._share[outline.parts]
        squared = distance.square() / (1.0 + (distance / _ROBUST).square())
        return total(weight * (found * squared + (1.0 - found) * _ROBUST**2))

    def _nearest(self, outline: Outline) -> tuple[Float[Tensor, " K"], Float[Tensor, " K"]]:
        """Distance to the edge along the outward normal [px], and 1 if an edge is found, else 0."""
        values = outline.camera, outline.position, outline.normal, self._samples, self._expected
        near = nearest_edges(as_array(self._gradient.permute(0, 2, 3, 1)), *map(as_array, values))
        distance, found = (torch.from_numpy(each).to(self._gradient.device) for each in near)
        return distance, found


class LocalEdgeFactor:
    """Edge factor near a point. Implements `Factor.linearize`.

    Small motions of outlines are computed from their Jacobian, since rendering is slow.
    """

    def __init__(self, factor: EdgeFactor, offsets: Float[Tensor, " n"], counts: Tensor, weight: float) -> None:
        self._factor, self._counts, self._weight = factor, counts, weight
        self._tangents = factor.renderer.tangents(factor.variables.around(offsets), DIFFERENCE_SPAN)
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
        """Edge cost of the last rendered outlines; see `EdgeFactor.cost`."""
        return self._factor.cost(self._outline, self._counts)

    def moved_by(self, step: Float[Tensor, " n"]) -> float:
        """Maximum motion of the outlines for a step [px]."""
        return self._outline.moved_by(step)


STILL = 0.03
"""Outline motion below which the alignment has converged [px]."""


@torch.no_grad()
def align_edges(
    edges: EdgeFactor,
    stage: AlignEdges,
    offsets: Float[Tensor, " n"],
    known: Linearization,
    coverage: Float[Tensor, "cameras rows columns"],
) -> tuple[Float[Tensor, " n"], Linearization]:
    """Minimize the sum of the edge factor and of a fixed quadratic model.

    Args:
        known: quadratic model of all other factors at `offsets`.
        coverage: observed coverage of the arms; see `EdgeFactor.near`.

    Returns:
        The minimum, and the quadratic model of the edge factor around it.
    """
    factor, variables, origin = edges.near(offsets, coverage, stage.weight), edges.variables, offsets
    step = torch.zeros_like(offsets)
    found = Linearization(0.0, torch.zeros_like(offsets), torch.zeros_like(known.hessian))
    for _ in range(stage.steps):
        found, before = factor.linearize(offsets), offsets
        gradient = known.gradient + known.hessian @ (before - origin) + found.gradient
        hessian = known.hessian + found.hessian
        step = bounded_step(before, gradient, hessian, variables.lower, variables.upper).to(offsets)
        offsets = variables.clamp(before + step)
        step = offsets - before
        if factor.moved_by(step) < STILL:
            break
    return offsets, Linearization(found.cost, found.gradient + found.hessian @ step, found.hessian)
