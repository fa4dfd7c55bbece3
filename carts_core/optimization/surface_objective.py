"""The surface objective for one frame: the surface map of a state against the one that the network sees in the image.

What the surface network predicts (parts and normals, see `carts_core.surface`) the renderer knows exactly for every
state, so no background, no shading and no network enter an iteration, and residuals have a Jacobian. A robust weight
per pixel keeps what cannot be explained (an occluder, a false detection) from pulling.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..features.extractor import FeatureExtractor
from ..losses import attention
from ..scene import Scene
from ..settings import OptimizerSettings
from ..surface import COVERAGE
from ..threads import total
from .comparison import Stage
from .counterfactual import Backgrounds
from .evaluation import Evaluation
from .observability import uncertainty
from .parameters import ParameterVector
from .scale import Scale, scaled
from .window import Window

_MARGIN = (27, 16)
"""What the network sees beyond the arms as they are believed to be [px of the working image]: in the first look and in
those that know better."""

_ATTENTION = (27, 8)
"""Distance from the arms as they are believed to be, beyond which nothing counts [px of the working image]: of the
first look and of those that know better. What is taken for an arm further off is none."""

_SUPPORT = 0.5
"""Share of an arm's silhouette that has to be seen as an arm, or the arm is lost [1]."""

_LEFT = 0.3
"""Share of the silhouette it started with that an arm has to keep, or it has gone elsewhere to be rid of it [1]."""

_SPREAD = 1.8
"""Deviation of random starts, in expected errors."""

_SLIDE = 5e-3
"""How far arms are slid along their shafts where the end of a look is in doubt [m]."""

_FINE = 2
"""Number of blurs that the first look leaves to the others."""

_GLANCE_ZOOM = 0.75
"""Largest `OptimizerSettings.zoom` of a glance [1]."""

_NEAR_START = 0.9
"""Overlap of the silhouettes of the start and of an estimate (Dice) above which the start may be as good [1]."""

_AS_WELL = 1.25
"""How many times larger the start's difference from what is seen may be than the estimate's, if it is as good [1]."""

_OUTLINE = 0.5
"""Expected error that all outlines seen in an image have in common, too far out or in [px of the working image]. It
says how near an arm is, so it matters most to the joints that move it along the line of sight."""


@dataclass(frozen=True)
class _View:
    """What the network saw in a look at the image."""

    look: int
    scale: Scale
    window: Window
    coverage: Float[Tensor, "cameras h w"]
    """Of all arms, in the window."""
    seen: tuple[Float[Tensor, "cameras 6 h w"], Float[Tensor, "cameras 1 h w"], Float[Tensor, "cameras 1 h w"]]
    """The surface map, what each pixel counts, and how far it is believed, in the window."""
    area: float
    """Of what is seen of arms, as far as it counts and is believed [px of the working image]."""
    stages: list[Stage]
    shown: Stage | None
    """What iterates are seen in; None for the stage that they are compared in."""


class SurfaceObjective:
    """Half the sum of robust squared residuals over all pixels, in units of the noise, and a prior.

    The network looks at the image `looks` times: first knowing the start, and again knowing what came of it. The first
    look serves the coarse stages, the second one the last of these again (it may see what the first one missed) and the
    last but one, each later one the last; with two looks, the second serves the last two. A glance, which is a look at
    a smaller image, comes before all these and takes the coarsest stages over: all but the last of the coarse ones. The
    first look is told the same as the glance, not what came of that: smoke may have fooled it.

    Args:
        scene: with the cameras that take part.
        images: camera name -> observed RGB image.
        extractor: the networks.
        parameters: the unknowns.
        settings: blurs, noise and prior.
        ignore: camera name -> pixels that show an occluder.
        backgrounds: of the cameras; what the network also sees in them is no arm. Without them, or where one is
            missing, all that it sees is believed.
        live: whether coarse stages are also rendered at the finest blur of their look, for someone who watches: losses
            compare through a look then, and maps are sharp. It takes a third more time and changes no step.

    Attributes:
        stages: number of stages.
        first_look: number of the first look that is no glance.

    Raises:
        SettingsError: an image is missing, or an image or a mask is of another size than its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        extractor: FeatureExtractor,
        parameters: ParameterVector,
        settings: OptimizerSettings,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]] | None = None,
        *,
        backgrounds: Backgrounds | None = None,
        live: bool = True,
    ) -> None:
        self.settings, self.parameters, self.scene, self._extractor = settings, parameters, scene, extractor
        self._live, self._backgrounds = live, backgrounds
        coarse, fine = settings.blurs[:-_FINE], settings.blurs[-_FINE:]
        self._coarsest = coarse[:-1]
        first = int(settings.glance and len(self._coarsest) > 0)
        self._plan = [(0, blur) for blur in self._coarsest] + [(first, blur) for blur in coarse[-1:]]
        if settings.looks > _FINE:
            self._plan += [(first + 1, blur) for blur in (*coarse[-1:], fine[0])]
            self._plan += [(first + look, fine[-1]) for look in range(2, settings.looks)]
        else:
            self._plan += [(first + settings.looks - 1, blur) for blur in fine]
        self.first_look = first
        self._begun_at: Tensor | None = None
        self.stages = len(self._plan)
        self._given = images, ignore or {}
        self._scales: dict[float, Scale] = {}
        self._scale(0)
        self._prior = parameters.expected(settings.prior_deg, settings.frame_prior_deg, settings.intrinsics_prior)
        self._view: _View | None = None

    def epoch(self, stage: int) -> int:
        """Losses compare within an epoch only: a look at the image, or a stage if nobody watches."""
        return self.look(stage) if self._live else stage

    def look(self, stage: int) -> int:
        """Which look at the image a stage belongs to."""
        return self._plan[stage][0]

    def __call__(self, offsets: Float[Tensor, " n"], stage: int, *, gradient: bool) -> Evaluation:
        """Evaluate at the given offsets; each stage of a look blurs less than the one before."""
        with torch.no_grad():
            look = self.look(stage)
            if self._view is None or look != self._view.look:
                if look < self.first_look:
                    self._begun_at = offsets
                begun_at = self._begun_at if look == self.first_look else None
                self._look_at(offsets if begun_at is None else begun_at, look)
            first = next(index for index, (number, _) in enumerate(self._plan) if number == look)
            return self._evaluate(offsets, self._viewed.stages[stage - first], gradient)

    def _scale(self, look: int) -> Scale:
        """The images as a look sees them."""
        zoom = self.settings.zoom
        if look < self.first_look:
            zoom = min(zoom, _GLANCE_ZOOM)
        if zoom not in self._scales:
            self._scales[zoom] = scaled(
                self.scene, *self._given, zoom, self.settings, self._extractor, self._backgrounds
            )
        return self._scales[zoom]

    @property
    def _viewed(self) -> _View:
        assert self._view is not None
        return self._view

    def lost(self, offsets: Float[Tensor, " n"]) -> bool:
        """Whether an arm that should be in sight is not where the offsets have it: nothing there is seen as an arm."""
        view = self._viewed
        whole = view.scale.whole
        start = whole.segment(self.parameters.state(torch.zeros_like(offsets)))
        found = view.window.of(torch.from_numpy(whole.segment(self.parameters.state(offsets))))
        found = found.to(view.coverage.device)
        for arm in range(len(self.scene.arms)):
            here = found == arm
            area, before = int(here.sum()), int((start == arm).sum())
            if before and (area < _LEFT * before or total(view.coverage[here]) < _SUPPORT * area):
                return True
        return False

    def seen(self) -> Float[Tensor, "cameras h w"]:
        """Where the last look saw arms: their coverage, in the whole compared image."""
        view = self._viewed
        width, height = view.scale.size
        return view.window.paste(view.coverage, view.coverage.new_zeros(len(view.coverage), height, width))

    @torch.no_grad()
    def promised(self, offsets: Float[Tensor, " n"], wider: ParameterVector) -> float:
        """Share of what the image still holds against a state that more unknowns would explain, by the linear model.

        What the present unknowns alone would still explain does not count, and a joint at its limit stays there.
        Compared is what the last look saw, under a blur as at the end of the coarse stages: a linear model reaches
        about as far as the blur.

        Args:
            offsets: of the present unknowns.
            wider: the present unknowns and others, from the same start.
        """
        settings = self.settings
        own = [wider.names.index(name) for name in self.parameters.names]
        point = torch.zeros_like(wider.lower).index_copy(0, torch.tensor(own, device=offsets.device), offsets)
        blur = settings.blurs[: max(len(settings.blurs) - _FINE, 1)][-1]
        view = self._viewed
        stage = Stage(self.scene, view.scale.size, view.scale.zoom, view.window, *view.seen, blur, settings)
        compared = stage.compare(wider.around(point), gradient=True)
        assert compared.gradient is not None and compared.curvature is not None
        prior = wider.expected(settings.prior_deg, settings.frame_prior_deg, settings.intrinsics_prior)
        gradient, curvature = compared.gradient.double(), compared.curvature.double()
        slope = prior.gradient(point).double() + gradient
        stiffness = prior.precision.double() + curvature
        held = ((point <= wider.lower) & (slope > 0)) | ((point >= wider.upper) & (slope < 0))
        explained = []
        for unknowns in (range(len(wider)), own):
            free = [index for index in unknowns if not held[index]]
            step = torch.zeros_like(slope)
            step[free] = torch.linalg.solve(stiffness[free][:, free], -slope[free])
            explained.append(-float(gradient @ step + 0.5 * step @ curvature @ step))
        return (explained[0] - explained[1]) * settings.noise**2 / max(compared.cost, 1e-12)

    @torch.no_grad()
    def better_start(self, offsets: Float[Tensor, " n"], candidates: int, seed: int = 0) -> Float[Tensor, " n"]:
        """Offsets worth starting from again: the best of random ones, arm by arm, in the coarsest stage.

        The network looks again for the first time, and now at the whole image.

        Args:
            offsets: what has been found so far; it and the start are among the candidates.
            candidates: number of random ones per arm, drawn from `_SPREAD` times what the prior expects.
            seed: of the random numbers.
        """
        generator = torch.Generator().manual_seed(seed)
        spread = _SPREAD * self._prior.marginal.rsqrt().cpu()
        best = offsets
        self._begun_at = None
        self._look_at(torch.zeros_like(offsets), 0, whole=True)
        for group in self.parameters.groups:
            columns = list(group)
            drawn = torch.stack([torch.randn(len(group), generator=generator) for _ in range(candidates + 1)])
            trials = best.repeat(len(drawn) + 1, 1)
            trials[1:, columns] = (drawn * spread[columns]).to(best)
            trials[1, columns] = 0.0
            trials = self.parameters.clamp(trials)
            best = trials[self._coarse_costs(trials).argmin()]
        return best

    @torch.no_grad()
    def slid(self, offsets: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Offsets with an arm slid along its shaft, if the image agrees with that better; the given ones if not.

        Told that a shaft ends too early, the network may see it end there; told the truth, it agrees more. So each is
        compared with what is seen by a network that is told it.
        """
        best, lowest = offsets, self._own_cost(offsets)
        for index in self.parameters.sliding:
            for distance in (-_SLIDE, _SLIDE):
                trial = offsets.clone()
                trial[index] += distance / float(self.parameters.scales[index])
                trial = self.parameters.clamp(trial)
                cost = self._own_cost(trial)
                if cost < lowest:
                    best, lowest = trial, cost
        self._look_at(best, self.first_look + 1)
        return best

    @torch.no_grad()
    def back_at_start(self, offsets: Float[Tensor, " n"]) -> bool:
        """Have the network look knowing the start, and say whether the start then explains the image as well.

        It does not where silhouettes differ much; nothing is looked at then. Where it does, that look becomes the
        present one; where not, the present one stays.
        """
        start, view = torch.zeros_like(offsets), self._viewed
        whole = view.scale.whole
        one, other = (whole.segment(self.parameters.state(point)) >= 0 for point in (start, offsets))
        if 2 * int((one & other).sum()) <= _NEAR_START * (int(one.sum()) + int(other.sum())):
            return False
        self._look_at(start, self.look(self.stages - 1))
        stage = self._viewed.stages[-1]
        before, after = stage.costs(self.parameters.state(torch.stack([start, offsets]))).tolist()
        prior = self._prior.value(start) - self._prior.value(offsets)
        gain = (before - after) / self.settings.noise**2 + float(prior)
        kept = gain < self.settings.keep_start and before < _AS_WELL * after
        if not kept:
            self._view = view
        return kept

    def forget(self) -> None:
        """Begin anew when asked next."""
        self._view, self._begun_at = None, None

    def _own_cost(self, offsets: Tensor) -> float:
        self._look_at(offsets, self.first_look + 1)
        return float(self._coarse_costs(offsets[None]))

    def _coarse_costs(self, offsets: Float[Tensor, "batch n"]) -> Float[Tensor, " batch"]:
        """The objective in the first stage of the present look."""
        costs = self._viewed.stages[0].costs(self.parameters.state(offsets))
        return costs / self.settings.noise**2 + self._prior.value(offsets)

    def _look_at(self, offsets: Tensor, look: int, whole: bool = False) -> None:
        """Have the network say what the image shows, knowing the present estimate: near the arms, or in all of it."""
        scale, later = self._scale(look), int(look > self.first_look)
        believed = scale.whole.surface_maps(self.parameters.state(offsets))
        margin = max(scale.size) if whole else round(_MARGIN[later] * scale.zoom)
        reach = round(_ATTENTION[later] * scale.zoom)
        window = Window.around(believed[:, COVERAGE].sum(1), margin, self._extractor.stride, scale.size)
        observed = self._extractor.surface(window.of(scale.images), window.of(believed))
        if scale.explained is not None:
            observed = observed * (1.0 - window.of(scale.explained))
        silhouette = window.of((believed[:, COVERAGE].sum(1) > 0).to(believed))
        near = attention(silhouette, reach) if silhouette.any() and not whole else torch.ones_like(silhouette)
        weight = window.of(scale.weight) * near[:, None]
        # A look that others follow up searches, and what it sees under a veil is better than nothing.
        decides = later or look == self.look(self.stages - 1)
        certain = window.of(scale.certainty) if decides else torch.ones_like(weight)
        seen = observed, weight, certain
        blurs = [blur for number, blur in self._plan if number == look]
        stages = [
            Stage(self.scene, scale.size, scale.zoom, window, *seen, blur, self._of(blur, whole)) for blur in blurs
        ]
        shown = stages[-1] if self._live else None
        if shown is not None and look < self.first_look:
            # A glance's own stages are too coarse to be shown.
            finer = self._plan[len(blurs)][1]
            shown = Stage(self.scene, scale.size, scale.zoom, window, *seen, finer, self.settings)
        coverage = observed[:, COVERAGE].sum(1)
        area = total(coverage * (weight * certain)[:, 0]) / scale.zoom**2
        self._view = _View(look, scale, window, coverage, seen, area, stages, shown)

    def _of(self, blur: float, whole: bool) -> OptimizerSettings:
        """Settings of a stage. What an image shows far from the arms is often none of them, so it is not believed."""
        settings = self.settings
        if whole or blur not in self._coarsest:
            return settings
        return replace(settings, robust=max(settings.robust, settings.coarse_robust))

    def _evaluate(self, offsets: Tensor, stage: Stage, gradient: bool) -> Evaluation:
        parameters = self.parameters
        state = parameters.around(offsets) if gradient else parameters.state(offsets)
        compared = stage.compare(state, gradient=gradient)
        shown = self._viewed.shown or stage
        final = compared if stage is shown else shown.compare(parameters.state(offsets), gradient=False)
        prior = float(self._prior.value(offsets))
        slope, curvature, known = torch.zeros_like(offsets), None, None
        if compared.gradient is not None and compared.curvature is not None and compared.outline is not None:
            slope = self._prior.gradient(offsets) + compared.gradient
            curvature = self._prior.precision + compared.curvature
            # As a part of a larger objective, unknowns have no prior here and are not judged.
            if bool((self._prior.precision.diagonal() > 0).all()):
                known = uncertainty(
                    self.parameters.names,
                    curvature,
                    self._prior.marginal,
                    self.parameters.scales,
                    _OUTLINE * compared.outline,
                )
        coverage = final.rendering.maps[:, COVERAGE].sum(1)
        # Weighted as the cost is, so that losses compare between clear images and veiled ones.
        rendered = total(coverage * shown.certainty[:, 0]) * shown.area
        area = 0.5 * max(rendered + self._viewed.area, 1.0)
        empty = coverage.new_zeros(len(coverage), shown.size[1], shown.size[0])
        paste = shown.window.paste
        return Evaluation(
            value=compared.cost / self.settings.noise**2 + prior,
            loss=2.0 * final.cost / area,
            prior=prior,
            gradient=slope,
            curvature=curvature,
            uncertainty=known,
            image=paste(final.rendering.image, empty[:, None].repeat(1, 3, 1, 1)),
            silhouette=paste(coverage, empty.clone()),
            similarity=paste(final.similarity, torch.ones_like(empty)),
            attention=paste(final.trust, empty),
        )
