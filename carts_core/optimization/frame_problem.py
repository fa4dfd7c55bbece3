"""Optimization problem of one frame: images, unknowns, prior and last observation."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import reduce
from operator import add

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..imaging.working_image import Window
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import Scene, SceneState
from ..settings import SurfaceSolver
from ..settings.stages import FINEST, AlignEdges, Descend, Given, Observe, SilhouetteSearch, first_observe
from ..threads import total
from .factors import Factor, Linearization, Prior
from .image_factors import EdgeFactor, SurfaceFactor, align_edges
from .observability import Evaluation, Uncertainty, uncertainty, uncertainty_after
from .observation import Backgrounds, FrameImages, Observation, observe
from .predictor import FramePredictor
from .variables import Variables
from .verdict import Evidence, evidence

_CONTRADICTS = 0.5
"""Similarity (1 minus the squared difference of surface maps) below which a pixel contradicts the estimate [1]."""
_SMALLEST, _NEAR, _GAP, _RIM = 2, 5, 7, 2
"""Radii at an image width of 320 px [px]: smallest object, distance from the silhouette, closed holes, and margin."""
_MOST = 0.5
"""Contradicting share of the silhouette above which the estimate is considered wrong instead of occluded [1]."""


def propose_ignore(
    scene: Scene, silhouette: Float[np.ndarray, "cameras h w"], similarity: Float[np.ndarray, "cameras h w"]
) -> dict[str, Bool[np.ndarray, "height width"]]:
    """Probable occluders: areas at the arms where the prediction differs from the rendering.

    Occluders predicted as background leave gaps in the arm; occluders predicted as instruments extend it. Both are
    proposed if they touch the silhouette.

    Args:
        silhouette: silhouette of an estimate, as in `Iterate`.

    Returns:
        Camera name -> mask at the camera's size; cameras without a proposal are omitted.
    """
    proposals = {}
    for camera, inside, alike in zip(scene.cameras, silhouette > 0.5, similarity, strict=True):
        scale = inside.shape[1] / 320.0
        contradicts = (alike < _CONTRADICTS).astype(np.uint8)
        _, labels = cv2.connectedComponents(cv2.morphologyEx(contradicts, cv2.MORPH_OPEN, _disc(_SMALLEST * scale)))
        near = cv2.dilate(inside.astype(np.uint8), _disc(_NEAR * scale)) > 0
        touching = np.unique(labels[near])
        chosen = np.isin(labels, touching[touching > 0]).astype(np.uint8)
        mask = cv2.dilate(cv2.morphologyEx(chosen, cv2.MORPH_CLOSE, _disc(_GAP * scale)), _disc(_RIM * scale))
        if mask.any() and (mask[inside] > 0).sum() <= _MOST * inside.sum():
            size = camera.width, camera.height
            proposals[camera.name] = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST).astype(bool)
    return proposals


def _disc(radius: float) -> np.ndarray:
    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


_COVERED = 0.5
"""Coverage threshold for mask pixels [1]."""

_ELITE = 0.1
"""Elite share of candidates, around which the next round is drawn [1]."""

_FIRST = 4
"""Factor for the number of candidates in the first round [1]."""

_LEAST = 0.02
"""Minimum standard deviation of a round, relative to the first round [1]."""

_HOLD = 0.05
"""Cost of a mean squared offset of one standard deviation [px]."""


def mask_distances(mask: Bool[np.ndarray, "*cameras h w"]) -> Float[np.ndarray, "*cameras h w"]:
    """Distance of each pixel to a mask, 0 inside; the image's width for an empty mask [px]."""
    flat = mask.reshape(-1, *mask.shape[-2:])
    found = [
        cv2.distanceTransform((~one).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        if one.any()
        else np.full(one.shape, float(one.shape[-1]), np.float32)
        for one in flat
    ]
    return np.stack(found).reshape(mask.shape)


def silhouette_distance(
    rendered: Bool[np.ndarray, "batch cameras h w"],
    masks: Bool[np.ndarray, "cameras h w"],
    weight: Bool[np.ndarray, "cameras h w"],
) -> Float[np.ndarray, " batch"]:
    """Symmetric mean distance of silhouettes and masks [px]."""
    to_masks = mask_distances(masks)
    rendered, masks = rendered & weight, masks & weight
    outside = (rendered * to_masks).sum((1, 2, 3)) / rendered.sum((1, 2, 3)).clip(min=1)
    missed = (mask_distances(rendered) * masks).sum((1, 2, 3)) / max(int(masks.sum()), 1)
    # An empty silhouette has the largest distance.
    outside[~rendered.any((1, 2, 3))] = rendered.shape[-1]
    return 0.5 * (outside + missed)


class SilhouetteComparison:
    """Comparison of one frame's silhouettes with given masks, in small images."""

    def __init__(self, images: FrameImages, predictor: FramePredictor) -> None:
        nothing = images.images.new_zeros(len(images.images), SURFACE_CHANNELS, *images.images.shape[-2:])
        maps = predictor.predict(images.images, nothing, Window(0, 0, *images.size))
        self._masks = (maps[:, COVERAGE].sum(1) > _COVERED).cpu().numpy()
        self._weight = (images.weight[:, 0] > _COVERED).cpu().numpy()
        self._renderer = images.renderer

    def overlap(self, state: SceneState) -> float:
        """Dice of silhouettes and masks over all cameras together; 1 if both are empty."""
        rendered = (self._renderer.segment(state) >= 0) & self._weight
        masks = self._masks & self._weight
        total = int(rendered.sum()) + int(masks.sum())
        return 2 * int((rendered & masks).sum()) / total if total else 1.0

    def distances(self, states: SceneState) -> Float[np.ndarray, " batch"]:
        """Distances of a batch of states from the masks; see `silhouette_distance`."""
        return silhouette_distance(self._renderer.segment(states) >= 0, self._masks, self._weight)


def search_silhouettes(
    distances: Callable[[Float[Tensor, "batch n"]], Float[np.ndarray, " batch"]],
    deviation: Float[Tensor, " n"],
    clamp: Callable[[Tensor], Tensor],
    stage: SilhouetteSearch,
) -> Float[Tensor, " n"]:
    """Minimize the distance between silhouettes and masks [px] by the cross-entropy method."""
    best, lowest = torch.zeros_like(deviation), float("inf")
    for start in range(stage.starts):
        generator = torch.Generator().manual_seed(start)
        mean, spread, best_here = torch.zeros_like(deviation), deviation.clone(), best
        for turn in range(stage.rounds):
            count = stage.candidates * (1 if turn else _FIRST)
            drawn = mean + spread * torch.randn(count, len(deviation), generator=generator).to(deviation)
            if turn:
                drawn[0] = best_here
            drawn = clamp(drawn)
            off = (drawn / deviation.clamp(min=1e-12)).square().mean(1).cpu().numpy()
            costs = distances(drawn) + _HOLD * off
            order = torch.from_numpy(np.argsort(costs)[: max(int(_ELITE * count), 2)])
            elite, best_here = drawn[order], drawn[order[0]]
            mean = elite.mean(0)
            spread = elite.std(0) + _LEAST * deviation
            if costs[order[0]] < lowest:
                best, lowest = best_here, float(costs[order[0]])
        if lowest < stage.enough:
            break
    return best


_SHOWN_BLUR = 1.6
"""Maximum blur under which displayed iterates are compared [px of the working image]."""


_BESIDE = ThreadPoolExecutor(2, "edges")
"""Thread pool that extracts image edges while the network runs."""


class FrameProblem:
    """Objective of one frame: surface factor of the last observation, prior, and additional factors.

    Args:
        ignore: camera name -> pixels that show an occluder.
        prior: prior of the unknowns, by default the prior of the settings.
        backgrounds: mean backgrounds of the cameras; arms predicted in them are false positives.
        live: whether coarse stages are also compared under a fine blur for display; see `FrameOptimizer`.

    Attributes:
        observation: the last observation; replaced by stages.
        observations: number of observations made.
        proposed: camera name -> pixels of proposed occluders.

    Raises:
        SettingsError: an image is missing, or the size of an image or mask differs from that of its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        predictor: FramePredictor,
        variables: Variables,
        settings: SurfaceSolver,
        ignore: Mapping[str, Bool[np.ndarray, "h w"]] | None = None,
        *,
        prior: Prior | None = None,
        factors: Sequence[Factor] = (),
        backgrounds: Backgrounds | None = None,
        live: bool = True,
    ) -> None:
        self.scene, self.variables, self.settings = scene, variables, settings
        self.prior = prior or variables.prior(settings)
        self._other_factors: tuple[Factor, ...] = (self.prior, *factors)
        self.predictor, self._backgrounds, self._live = predictor, backgrounds, live
        self._observed, self._given_ignore = images, ignore or {}
        self._ignore = self._given_ignore
        self._images: dict[float, FrameImages] = {}
        self._replaced: bool | None = None
        self._evidence: tuple[Tensor, Evidence] | None = None
        self._edges: Future[EdgeFactor] | None = None
        self._factors: dict[tuple[float, float], SurfaceFactor] = {}
        self._observation: Observation | None = None
        self.observations = 0
        self.proposed: dict[str, Bool[np.ndarray, "h w"]] = {}
        self.images(first_observe(settings.stages).scale)
        if any(isinstance(stage, AlignEdges) for stage in settings.stages):
            # Image edges are extracted while the network runs.
            self._edges = self._edges_beside()

    @property
    def start(self) -> Float[Tensor, " n"]:
        """Offsets of the start: zeros."""
        return torch.zeros_like(self.variables.lower)

    @property
    def observation(self) -> Observation:
        """The last observation."""
        assert self._observation is not None, "the first stage must be Observe"
        return self._observation

    @observation.setter
    def observation(self, observation: Observation) -> None:
        self._observation, self._factors = observation, {}
        self.observations += 1

    def images(self, scale: float) -> FrameImages:
        """Images at a scale relative to the working image."""
        if scale not in self._images:
            self._images[scale] = FrameImages.of(
                self.scene,
                self._observed,
                self._ignore,
                self.settings,
                self.predictor,
                scale=scale,
                backgrounds=self._backgrounds,
                replaced=self._replaced,
            )
        return self._images[scale]

    def toggle_background_mode(self) -> None:
        """Switch between replacing the empty background in the images and subtracting the network's predictions in the
        background."""
        self._replaced = not self.images(1.0).replaced
        self._images, self._evidence = {}, None

    def reset(self) -> None:
        """Drop the observation, the proposed ignore mask and the background mode."""
        if self.proposed or self._replaced is not None:
            self._ignore, self._images, self._edges = self._given_ignore, {}, None
        self._replaced = self._evidence = None
        self._observation, self._factors, self.observations, self.proposed = None, {}, 0, {}

    def observe(self, stage: Observe, offsets: Float[Tensor, " n"], *, whole: bool = False) -> None:
        """Predict surface maps, conditioned on the start or on an estimate."""
        state = self.variables.state(self.start if stage.given is Given.START else offsets)
        self.observation = observe(self.images(stage.scale), self.predictor, state, stage, whole=whole)

    def ignore_occluders(self, evaluation: Evaluation) -> bool:
        """Add probable occluders to the ignore mask; returns whether there are any."""
        silhouette, similarity = evaluation.silhouette.cpu().numpy(), evaluation.similarity.cpu().numpy()
        self.proposed = propose_ignore(self.scene, silhouette, similarity)
        if self.proposed:
            masks = {name: mask | self._ignore.get(name, False) for name, mask in self.proposed.items()}
            self._ignore, self._images, self._edges = {**self._ignore, **masks}, {}, None
            self._evidence = None
        return bool(self.proposed)

    def factor(self, stage: Descend) -> SurfaceFactor:
        """Surface factor of the last observation, with the blur of a stage."""
        key = stage.blur, stage.robust
        if key not in self._factors:
            self._factors[key] = SurfaceFactor(self.scene, self.variables, self.observation, self.settings, stage)
        return self._factors[key]

    def objective_key(self, blur: float) -> tuple[int, float]:
        """Key of the objective: the observation and, if not live, the blur. Losses are comparable within one key."""
        return self.observations, 0.0 if self._live else blur

    @torch.no_grad()
    def costs(self, offsets: Float[Tensor, "batch n"], stage: Descend) -> Float[Tensor, " batch"]:
        """Objective at a batch of points, under the blur of a stage."""
        return self.factor(stage).costs(offsets) + self.other_costs(offsets)

    def other_costs(self, offsets: Float[Tensor, "batch n"]) -> Float[Tensor, " batch"]:
        """Cost of all factors except the surface factor at a batch of points."""
        return torch.stack([factor.costs(offsets) for factor in self._other_factors]).sum(0)

    def uncertainty_after(self, offsets: Float[Tensor, " n"], evaluation: Evaluation) -> Uncertainty | None:
        """Standard deviations at the end of a fit, from a nearby evaluation with a gradient."""
        known = evaluation.uncertainty
        if evaluation.hessian is None or evaluation.outline_gradient is None or known is None:
            return None
        start_share = 0.0 if self.predictor.masked else self.settings.start_share
        moved = offsets - self.prior.mean
        later = uncertainty_after(
            self.variables, self.prior, evaluation.hessian, evaluation.outline_gradient, moved, start_share
        )
        return known.rescaled(later)

    @torch.no_grad()
    def evaluate(self, offsets: Float[Tensor, " n"], stage: Descend, *, gradient: bool = True) -> Evaluation:
        """Evaluate the objective at a point, under the blur of a stage; with `gradient`, including its quadratic
        model."""
        factor = self.factor(stage)
        others = reduce(add, (other.linearize(offsets) for other in self._other_factors))
        slope, hessian, outline_gradient, known = torch.zeros_like(offsets), None, None, None
        if gradient:
            surface = factor.linearize(offsets)
            compared, total = surface.comparison, others + surface
            slope, hessian = total.gradient, total.hessian
            outline_gradient = self.settings.outline_error * surface.outline
            known = uncertainty(self.variables, self.prior, hessian, outline_gradient)
        else:
            compared = factor.compare(offsets)
        shown, final = factor, compared
        if self._live and stage.blur > _SHOWN_BLUR:
            shown = self.factor(Descend(_SHOWN_BLUR))
            final = shown.compare(offsets)
        coverage = final.rendering.maps[:, COVERAGE].sum(1)
        empty = coverage.new_zeros(len(coverage), shown.size[1], shown.size[0])
        paste = shown.window.paste
        return Evaluation(
            value=compared.pixels / factor.noise**2 + others.cost,
            loss=self._loss(shown, final),
            stage_loss=self._loss(factor, compared),
            gradient=slope,
            hessian=hessian,
            outline_gradient=outline_gradient,
            uncertainty=known,
            image=paste(final.rendering.image, empty[:, None].repeat(1, 3, 1, 1)),
            silhouette=paste(coverage, empty.clone()),
            similarity=paste(final.similarity, torch.ones_like(empty)),
            attention=paste(final.trust, empty),
        )

    def evidence(self, offsets: Float[Tensor, " n"], loss: float) -> Evidence:
        """Evidence for and against a point with known loss."""
        if self._evidence is None or not torch.equal(self._evidence[0], offsets):
            start, end = (self.variables.state(at) for at in (self.start, offsets))
            self._evidence = offsets.clone(), evidence(self.images(1.0), start, end, self.predictor, loss)
        return replace(self._evidence[1], loss=loss)

    def evidence_at(self, offsets: Float[Tensor, " n"]) -> Evidence:
        """Evidence for and against a point; its loss is computed under the last observation."""
        return self.evidence(offsets, self.evaluate(offsets, FINEST, gradient=False).loss)

    @property
    def distance(self) -> float:
        """Median distance of the arms' links from the cameras at the start [m]."""
        return self.scene.distance(self.variables.start)

    @property
    def masked(self) -> bool:
        """Whether given masks are the target."""
        return self.predictor.masked

    def silhouettes(self, scale: float) -> SilhouetteComparison:
        """Comparison of silhouettes with the given masks, at an image scale."""
        return SilhouetteComparison(self.images(scale), self.predictor)

    def silhouette_overlap(self, offsets: Float[Tensor, " n"], scale: float) -> float:
        """Dice of silhouettes and masks."""
        return self.silhouettes(scale).overlap(self.variables.state(offsets))

    def search_silhouettes(self, stage: SilhouetteSearch) -> Float[Tensor, " n"]:
        """Search for the offsets whose silhouettes are nearest to the masks."""
        compared, variables = self.silhouettes(stage.scale), self.variables
        deviation = variables.standard_deviations(stage.joints_deg, stage.frames_deg, self.distance)
        return search_silhouettes(
            lambda trials: compared.distances(variables.state(trials)), deviation, variables.clamp, stage
        )

    def _loss(self, factor: SurfaceFactor, compared) -> float:
        """Twice the cost divided by the arm area, the mean of the rendered and the observed area.

        The area has the same weights as the cost, so that losses of clear and hazy images are comparable.
        """
        coverage = compared.rendering.maps[:, COVERAGE].sum(1)
        rendered = total(coverage * (factor.weight * factor.certainty)[:, 0]) * factor.area
        return 2.0 * compared.pixels / (0.5 * max(rendered + self.observation.area, 1.0))

    def aligned(
        self, stage: AlignEdges, offsets: Float[Tensor, " n"], known: Evaluation
    ) -> tuple[Float[Tensor, " n"], Linearization]:
        """Align outlines with edges, starting at an evaluated point; see `align_edges`."""
        assert known.hessian is not None
        model = Linearization(known.value, known.gradient, known.hessian)
        return align_edges(self._edge_factor(), stage, offsets, model, self.observation.whole_coverage())

    def edge_distance(self, offsets: Float[Tensor, " n"]) -> float:
        """Edge cost of the outlines at a point; see `EdgeFactor.cost`."""
        return self._edge_factor().near(offsets, self.observation.whole_coverage(), AlignEdges.weight).cost()

    def _edge_factor(self) -> EdgeFactor:
        if self._edges is None:
            self._edges = self._edges_beside()
        return self._edges.result()

    def _edges_beside(self) -> Future[EdgeFactor]:
        problem = self.scene, self._observed, self.variables, self._ignore
        return _BESIDE.submit(EdgeFactor, *problem, self.settings, self.predictor.device)
