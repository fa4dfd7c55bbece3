"""A predictor that is never wrong, in place of a trained network; and solvers without some of their stages."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional

from carts_core.imaging.working_image import Window
from carts_core.model.scene import Scene, SceneState
from carts_core.optimization import ImagePredictor
from carts_core.recording import Frame, Sequence
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


def numbered(frame: Frame) -> Frame:
    """The frame with joints measured without an error; its images are as bright as its number."""
    images = {camera: np.full_like(image, frame.index) for camera, image in frame.images.items()}
    return replace(frame, measured=frame.truth or {}, images=images)


class NumberedTruths(ImagePredictor):
    """Predicts the surface maps of the truth of `numbered` frames."""

    device = torch.device("cpu")
    stride = 16

    def __init__(self, scene: Scene, frames: Iterable[Frame]) -> None:
        renderer = Renderer(scene, width=640, height=480)
        states = [scene.state(frame.truth or {}, mounts=frame.mounts) for frame in frames]
        self.maps = [renderer.surface(state).maps for state in states]

    def predict(self, images: torch.Tensor, given: torch.Tensor, window: Window) -> torch.Tensor:
        """The truth in a window, of the frame whose images these are."""
        maps = self.maps[round(255 * float(images[0, 0, 0, 0]))]
        return window.of(functional.interpolate(maps, images.shape[-2:], mode="area"))[: len(images)]


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
