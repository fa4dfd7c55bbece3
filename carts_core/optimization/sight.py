"""What one frame's images say of its correction, near a place where it is looked for."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..data import Frame
from ..features.extractor import FeatureExtractor
from ..scene import Scene
from ..settings import OptimizerSettings
from .counterfactual import Backgrounds
from .edges import EdgeRefinement
from .error_model import Gaussian, Information
from .evaluation import Evaluation, Objective
from .parameters import ParameterVector
from .prior import Prior
from .restart import Restart
from .solvers import make_solver
from .surface_objective import SurfaceObjective

Ignore = Callable[[int], Mapping[str, Bool[np.ndarray, "h w"]]]

_WARM_STEPS, _WARM_TOLERANCE = 2, 1e-2
"""As `stage_iterations` and `tolerance`: the linear model at the last step takes care of what is left."""

_QUICK_ZOOM, _LOSS_ZOOM = 1.0, 1.25
"""Largest `OptimizerSettings.zoom` of a quick cold start, and of given corrections that are only compared [1]."""


@dataclass(frozen=True)
class Sight:
    """The end of a descent in one frame."""

    correction: Float[np.ndarray, " n"]
    """Best for image and prior together [rad]."""
    information: Information
    """Of the image alone, linearized there, and believed as far as `sight_noise` allows."""
    loss: float
    iterations: int


class Eye:
    """Looks at frames.

    Args:
        scene: with the cameras that take part.
        extractor: the networks.
        settings: of a cold start; a warm one has its finest blur, one look and few steps.
        sight_noise: as `OptimizerSettings.noise`, for what a frame tells.
        ignore: position of a frame -> camera name -> pixels that show an occluder.
        backgrounds: of the cameras, where they are known.
    """

    def __init__(
        self,
        scene: Scene,
        extractor: FeatureExtractor,
        settings: OptimizerSettings,
        sight_noise: float,
        ignore: Ignore,
        backgrounds: Backgrounds | None = None,
    ) -> None:
        self._scene, self._extractor, self._coarse, self._ignore = scene, extractor, settings, ignore
        self._backgrounds = backgrounds
        self._share = (settings.noise / sight_noise) ** 2
        self._fine = replace(
            settings,
            blurs=settings.blurs[-1:],
            looks=1,
            stage_iterations=min(settings.stage_iterations, _WARM_STEPS),
            tolerance=max(settings.tolerance, _WARM_TOLERANCE),
        )
        self._quick = replace(settings, zoom=min(settings.zoom, _QUICK_ZOOM))
        self._brief = replace(self._fine, zoom=min(settings.zoom, _LOSS_ZOOM))

    def warm(self, frame: Frame, parameters: ParameterVector, expected: Gaussian, start: np.ndarray) -> Sight:
        """Find the correction near `start` [n]."""
        parameters.prior = _prior(expected, parameters)
        start = _double(parameters.clamp(torch.from_numpy(start).to(parameters.lower)))
        objective = self._objective(frame, parameters, self._fine)
        end = _descend(objective, parameters, self._fine, start)
        if self._fine.draws_to_edges:
            end = self._drawn_to_edges(frame, parameters, end, objective.seen())
        return replace(end, information=end.information.scaled(self._share))

    def _drawn_to_edges(self, frame: Frame, parameters: ParameterVector, end: Sight, coverage: Tensor) -> Sight:
        """What is seen, and what edges near it say."""
        assert parameters.prior is not None
        refinement = EdgeRefinement(
            self._scene, frame.images, parameters, self._fine, self._ignore(frame.index), self._extractor.device
        )
        seen, offsets = end.information, torch.from_numpy(end.correction).to(parameters.lower)
        slope = torch.from_numpy(seen.precision @ end.correction - seen.vector).to(offsets)
        gradient = parameters.prior.gradient(offsets) + slope
        curvature = parameters.prior.precision + torch.from_numpy(seen.precision).to(offsets)
        drawn = refinement(offsets, gradient, curvature, coverage)
        correction, precision = _double(drawn.offsets), _double(drawn.curvature)
        vector = precision @ correction - _double(drawn.gradient)
        information = Information(seen.precision + precision, seen.vector + vector)
        return replace(end, correction=correction, information=information)

    def cold(self, frame: Frame, parameters: ParameterVector, expected: Gaussian, *, quick: bool = False) -> Sight:
        """Find the correction from the measured values on, coarse to fine; quick in smaller images but for the end."""
        settings = self._quick if quick else self._coarse
        parameters.prior = _prior(expected, parameters)
        objective = self._objective(frame, parameters, settings)
        found = _descend(objective, parameters, settings, np.zeros(len(parameters)))
        end = self.warm(frame, parameters, expected, found.correction)
        return replace(end, iterations=found.iterations + end.iterations)

    def at(self, frame: Frame, parameters: ParameterVector, expected: Gaussian, correction: np.ndarray) -> Sight:
        """Evaluate a given correction [n], no more."""
        parameters.prior = _prior(expected, parameters)
        objective = self._objective(frame, parameters, self._fine)
        offsets = torch.from_numpy(correction).to(parameters.lower)
        evaluation = objective(offsets, objective.stages - 1, gradient=True)
        information = _information(offsets, evaluation, parameters).scaled(self._share)
        return Sight(correction, information, evaluation.loss, 0)

    def losses(self, frame: Frame, parameters: ParameterVector, corrections: Sequence[np.ndarray]) -> list[float]:
        """How badly given corrections [n] fit, in a smaller image; the network is told each before it looks."""
        objective, found = self._objective(frame, parameters, self._brief), []
        for correction in corrections:
            objective.forget()
            offsets = parameters.clamp(torch.from_numpy(correction).to(parameters.lower))
            found.append(objective(offsets, objective.stages - 1, gradient=False).loss)
        return found

    def _objective(self, frame: Frame, parameters: ParameterVector, settings: OptimizerSettings) -> SurfaceObjective:
        ignore = self._ignore(frame.index)
        return SurfaceObjective(
            self._scene,
            frame.images,
            self._extractor,
            parameters,
            settings,
            ignore,
            backgrounds=self._backgrounds,
            live=False,
        )


def _prior(expected: Gaussian, parameters: ParameterVector) -> Prior:
    like = parameters.lower
    precision = np.linalg.inv(expected.covariance)
    return Prior(torch.from_numpy(expected.mean).to(like), torch.from_numpy(precision).to(like))


def _descend(
    objective: Objective, parameters: ParameterVector, settings: OptimizerSettings, start: Float[np.ndarray, " n"]
) -> Sight:
    solver = make_solver(settings, parameters, objective.stages)
    offsets = parameters.clamp(torch.from_numpy(start).to(parameters.lower))
    restart = Restart(settings, objective, solver)
    best: tuple[Tensor, Evaluation] | None = None
    iterations, last = 0, objective.stages - 1
    lowest: dict[int, float] = {}
    while solver.finished is None:
        stage = solver.stage
        evaluation = objective(offsets, stage, gradient=True)
        iterations += 1
        if stage == last and (best is None or evaluation.value < best[1].value):
            best = offsets, evaluation
        lowest[stage] = min(evaluation.loss, lowest.get(stage, evaluation.loss))
        offsets = restart(stage, solver(offsets, evaluation), lowest[stage])
    best = best or (offsets, objective(offsets, last, gradient=True))
    return Sight(_double(best[0]), _information(*best, parameters), best[1].loss, iterations)


def _information(offsets: Tensor, evaluation: Evaluation, parameters: ParameterVector) -> Information:
    assert evaluation.curvature is not None and parameters.prior is not None
    precision = _double(evaluation.curvature - parameters.prior.precision)
    # Without what rounding took below 0: information is never negative.
    values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
    precision = vectors @ np.diag(values.clip(min=0.0)) @ vectors.T
    slope = _double(evaluation.gradient - parameters.prior.gradient(offsets))
    return Information(precision, precision @ _double(offsets) - slope)


def _double(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()
