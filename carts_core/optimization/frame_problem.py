"""One frame as an optimization problem: its images, the unknowns, a prior, and what was observed last."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..model.parts import COVERAGE
from ..model.scene import Scene
from ..settings import SurfaceSolver
from ..settings.stages import FINEST, AlignEdges, Descend, Given, Observe, SilhouetteSearch, first_observe
from ..threads import total
from .counterfactual import Backgrounds
from .edge_alignment import align_edges
from .evaluation import Evaluation
from .evidence import Evidence, evidence
from .factors import Factor, Linearization, Prior
from .factors.edges import EdgeFactor
from .factors.surface import SurfaceFactor
from .frame_images import FrameImages
from .ignore import propose_ignore
from .observability import Uncertainty, uncertainty
from .observation import Observation, observe
from .predictor import FramePredictor
from .silhouettes import SilhouetteComparison, search_silhouettes
from .variables import Variables

_SHOWN_BLUR = 1.6
"""Iterates that are displayed are compared under a blur of at most this [px of the working image]."""


_BESIDE = ThreadPoolExecutor(2, "edges")
"""Does what needs the images alone while the network runs."""


class FrameProblem:
    """The sum of the surface factor of the last observation, the prior, and further factors.

    Args:
        scene: with the cameras that take part.
        images: camera name -> observed RGB image.
        predictor: predicts surface maps.
        variables: the unknowns.
        settings: noise, weights, working size.
        ignore: camera name -> pixels that show an occluder.
        prior: of the unknowns; as the settings expect by default.
        factors: further ones over the same unknowns.
        backgrounds: of the cameras; what is predicted in them as well counts as a false positive.
        live: whether coarse stages are also compared under a fine blur, for a display. It takes a third
            more time and changes no step.

    Attributes:
        observation: the last one; stages replace it.
        observations: how many there were.
        proposed: camera name -> pixels that were left out on a proposal.

    Raises:
        SettingsError: an image is missing, or an image or a mask is of another size than its camera.
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
            # Edges of the image are found while the network runs.
            self._edges = self._edges_beside()

    @property
    def start(self) -> Float[Tensor, " n"]:
        """Where all offsets are 0."""
        return torch.zeros_like(self.variables.lower)

    @property
    def observation(self) -> Observation:
        """The last one."""
        assert self._observation is not None, "a solver begins with Observe"
        return self._observation

    @observation.setter
    def observation(self, observation: Observation) -> None:
        self._observation, self._factors = observation, {}
        self.observations += 1

    def images(self, scale: float) -> FrameImages:
        """The images at a scale."""
        if scale not in self._images:
            self._images[scale] = FrameImages.of(
                self.scene,
                self._observed,
                self._ignore,
                scale=scale,
                working_width=self.settings.working_width,
                dehaze=self.settings.dehaze,
                predictor=self.predictor,
                backgrounds=self._backgrounds,
                replaced=self._replaced,
            )
        return self._images[scale]

    def treat_background_otherwise(self) -> None:
        """Replace the empty background where it was taken off the predictions so far, or the other way round."""
        self._replaced = not self.images(1.0).replaced
        self._images, self._evidence = {}, None

    def reset(self) -> None:
        """Drop the observation, the proposed ignore mask and the other treatment of the background."""
        if self.proposed or self._replaced is not None:
            self._ignore, self._images, self._edges = self._given_ignore, {}, None
        self._replaced = self._evidence = None
        self._observation, self._factors, self.observations, self.proposed = None, {}, 0, {}

    def observe(self, stage: Observe, offsets: Float[Tensor, " n"], *, whole: bool = False) -> None:
        """Have surface maps of the images predicted, conditioned on the start or on an estimate."""
        state = self.variables.state(self.start if stage.given is Given.START else offsets)
        self.observation = observe(self.images(stage.scale), self.predictor, state, stage, whole=whole)

    def ignore_occluders(self, evaluation: Evaluation) -> bool:
        """Leave out pixels that probably show an occluder, from a fit's evaluation; False if there are none."""
        silhouette, similarity = evaluation.silhouette.cpu().numpy(), evaluation.similarity.cpu().numpy()
        self.proposed = propose_ignore(self.scene, silhouette, similarity)
        if self.proposed:
            masks = {name: mask | self._ignore.get(name, False) for name, mask in self.proposed.items()}
            self._ignore, self._images, self._edges = {**self._ignore, **masks}, {}, None
            self._evidence = None
        return bool(self.proposed)

    def factor(self, stage: Descend) -> SurfaceFactor:
        """The surface factor of the last observation, as a stage compares it."""
        key = blur, robust = stage.blur, stage.robust
        if key not in self._factors:
            self._factors[key] = SurfaceFactor(
                self.scene, self.variables, self.observation, self.settings, blur=blur, robust=robust
            )
        return self._factors[key]

    def objective_key(self, blur: float) -> tuple[int, float]:
        """Which objective it is: one observation and, if not live, one blur. Losses compare within it."""
        return self.observations, 0.0 if self._live else blur

    @torch.no_grad()
    def costs(self, offsets: Float[Tensor, "batch n"], stage: Descend) -> Float[Tensor, " batch"]:
        """The objective at each of a batch of points, as a stage compares it."""
        return self.factor(stage).costs(offsets) + self.other_costs(offsets)

    def other_costs(self, offsets: Float[Tensor, "batch n"]) -> Float[Tensor, " batch"]:
        """The cost of all factors but the surface factor at each of a batch of points."""
        return torch.stack([factor.costs(offsets) for factor in self._other_factors]).sum(0)

    def uncertainty_after(self, offsets: Float[Tensor, " n"], evaluation: Evaluation) -> Uncertainty | None:
        """Deviations where a fit has ended, near an evaluation with a gradient."""
        start_share = 0.0 if self.predictor.masked else self.settings.start_share
        return evaluation.final_uncertainty(offsets, self.variables, self.prior, start_share)

    @torch.no_grad()
    def evaluate(self, offsets: Float[Tensor, " n"], stage: Descend, *, gradient: bool = True) -> Evaluation:
        """The objective at a point, as a stage compares it; with a gradient, its quadratic model, too."""
        factor = self.factor(stage)
        others = reduce(add, (other.linearize(offsets) for other in self._other_factors))
        slope, hessian, common, known = torch.zeros_like(offsets), None, None, None
        if gradient:
            surface = factor.linearize(offsets)
            compared, total = surface.comparison, others + surface
            slope, hessian = total.gradient, total.hessian
            common = self.settings.outline_error * surface.outline
            known = uncertainty(self.variables, self.prior, hessian, common)
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
            common=common,
            uncertainty=known,
            image=paste(final.rendering.image, empty[:, None].repeat(1, 3, 1, 1)),
            silhouette=paste(coverage, empty.clone()),
            similarity=paste(final.similarity, torch.ones_like(empty)),
            attention=paste(final.trust, empty),
        )

    def evidence(self, offsets: Float[Tensor, " n"], loss: float) -> Evidence:
        """What the images say for and against a point whose loss is known."""
        if self._evidence is None or not torch.equal(self._evidence[0], offsets):
            start, end = (self.variables.state(at) for at in (self.start, offsets))
            self._evidence = offsets.clone(), evidence(self.images(1.0), start, end, self.predictor, loss)
        return replace(self._evidence[1], loss=loss)

    def evidence_at(self, offsets: Float[Tensor, " n"]) -> Evidence:
        """What the images say for and against a point, under the last observation."""
        return self.evidence(offsets, self.evaluate(offsets, FINEST, gradient=False).loss)

    @property
    def distance(self) -> float:
        """Of the arms from the cameras at the start [m]."""
        return self.scene.distance(self.variables.start)

    @property
    def masked(self) -> bool:
        """Whether given masks are the target."""
        return self.predictor.masked

    def silhouettes(self, scale: float) -> SilhouetteComparison:
        """Silhouettes against the given masks, in images of a scale."""
        return SilhouetteComparison(self.images(scale), self.predictor)

    def silhouette_overlap(self, offsets: Float[Tensor, " n"], scale: float) -> float:
        """Overlap of silhouettes and masks (Dice)."""
        return self.silhouettes(scale).overlap(self.variables.state(offsets))

    def search_silhouettes(self, stage: SilhouetteSearch) -> Float[Tensor, " n"]:
        """Where silhouettes are nearest to the masks."""
        compared, variables = self.silhouettes(stage.scale), self.variables
        deviation = variables.spread(stage.joints_deg, stage.frames_deg, self.distance)
        found, _ = search_silhouettes(
            lambda trials: compared.distances(variables.state(trials)), deviation, variables.clamp, stage
        )
        return found

    def _loss(self, factor: SurfaceFactor, compared) -> float:
        """The cost per pixel of the arms, as rendered and as observed.

        The area is weighted as the cost is, so that losses compare between clear and hazy images.
        """
        coverage = compared.rendering.maps[:, COVERAGE].sum(1)
        rendered = total(coverage * factor.certainty[:, 0]) * factor.area
        return 2.0 * compared.pixels / (0.5 * max(rendered + self.observation.area, 1.0))

    def aligned(
        self, stage: AlignEdges, offsets: Float[Tensor, " n"], known: Evaluation
    ) -> tuple[Float[Tensor, " n"], Linearization]:
        """Outlines drawn to edges from a point whose evaluation is known; see `align_edges`."""
        assert known.hessian is not None
        model = Linearization(known.value, known.gradient, known.hessian)
        return align_edges(self._edge_factor(), stage, offsets, model, self.observation.whole_coverage())

    def edge_distance(self, offsets: Float[Tensor, " n"]) -> float:
        """How far outlines are from edges at a point; see `EdgeFactor.cost`."""
        return self._edge_factor().near(offsets, self.observation.whole_coverage(), AlignEdges.weight).cost()

    def _edge_factor(self) -> EdgeFactor:
        if self._edges is None:
            self._edges = self._edges_beside()
        return self._edges.result()

    def _edges_beside(self) -> Future[EdgeFactor]:
        return _BESIDE.submit(
            EdgeFactor,
            self.scene,
            self._observed,
            self.variables,
            self._ignore,
            working_width=self.settings.working_width,
            dehaze=self.settings.dehaze,
            device=self.predictor.device,
        )
