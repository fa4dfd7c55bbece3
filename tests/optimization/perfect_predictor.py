"""A predictor that is never wrong, in place of a trained network; and solvers without some of their stages."""

from dataclasses import replace

import torch
from torch.nn import functional

from carts_core.imaging.working_image import Window
from carts_core.model.scene import SceneState
from carts_core.optimization import ImagePredictor
from carts_core.recording import Sequence
from carts_core.rendering import Renderer
from carts_core.settings import SurfaceSolver
from carts_core.settings.stages import Stage


class PerfectPredictor(ImagePredictor):
    """Predicts the surface map of the truth, whatever it is shown."""

    device = torch.device("cpu")
    stride = 16

    def __init__(self, sequence: Sequence, truth: SceneState) -> None:
        self.maps = Renderer(sequence.scene, width=640, height=480).surface(truth).maps

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """The truth in a window."""
        return window.of(functional.interpolate(self.maps, images.shape[-2:], mode="area")).clone()


def without(kind: type, settings: SurfaceSolver | None = None, **changes) -> SurfaceSolver:
    """A solver without one kind of stages."""
    settings = settings or SurfaceSolver()
    kept: tuple[Stage, ...] = tuple(stage for stage in settings.stages if not isinstance(stage, kind))
    return replace(settings, stages=kept, **changes)


def with_stage(kind: type, settings: SurfaceSolver | None = None, **changes) -> SurfaceSolver:
    """A solver whose stages of one kind have other values."""
    settings = settings or SurfaceSolver()
    stages = tuple(replace(stage, **changes) if isinstance(stage, kind) else stage for stage in settings.stages)
    return replace(settings, stages=stages)
