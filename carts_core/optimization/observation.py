"""What a predictor saw in the images of a frame, given a state. Nothing later changes it."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from ..imaging.window import Window
from ..model.parts import COVERAGE
from ..model.scene import SceneState
from ..settings.stages import Observe
from ..threads import total
from .frame_images import FrameImages
from .losses import attention
from .predictor import FramePredictor


@dataclass(frozen=True)
class Observation:
    """Predicted surface maps in a window of the images, and what their pixels are worth."""

    images: FrameImages
    """The images that were observed."""
    window: Window
    """Which part of it [px of these images]."""
    maps: Float[Tensor, "cameras 6 h w"]
    """Predicted surface maps, in the window."""
    weight: Float[Tensor, "cameras 1 h w"]
    """What each pixel counts: 0 far from the arms and where an occluder is known to be."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """Information of a pixel, as a share of what it would have without smoke and haze [1]."""
    knows_parts: bool = True
    """Whether parts and normals are predicted, and not only the coverage of the whole arm."""
    masked: bool = False
    """Whether the coverage is that of given masks."""

    @property
    def coverage(self) -> Float[Tensor, "cameras h w"]:
        """Of all arms, in the window."""
        return self.maps[:, COVERAGE].sum(1)

    @cached_property
    def area(self) -> float:
        """Of the predicted arms, as far as they count [px of the working image]."""
        return total(self.coverage * (self.weight * self.certainty)[:, 0]) / self.images.scale**2

    def whole_coverage(self) -> Float[Tensor, "cameras height width"]:
        """Coverage of the arms in the whole image, 0 outside the window."""
        coverage = self.coverage
        width, height = self.images.size
        return self.window.paste(coverage, coverage.new_zeros(len(coverage), height, width))


@torch.no_grad()
def observe(
    images: FrameImages, predictor: FramePredictor, state: SceneState, stage: Observe, *, whole: bool = False
) -> Observation:
    """Predict surface maps.

    Args:
        images: of the frame, in the stage's scale.
        predictor: who predicts.
        state: that the prediction is conditioned on.
        stage: how far around its arms.
        whole: predict the whole image, and have all of it count.
    """
    given = images.renderer.surface_maps(state)
    everything = whole or predictor.masked
    margin = max(images.size) if everything else round(stage.margin * images.scale)
    reach = round(stage.attention * images.scale)
    window = Window.around(given[:, COVERAGE].sum(1), margin, predictor.stride, images.size)
    maps = predictor.predict(images.images, given, window)
    if images.explained is not None:
        maps = maps * (1.0 - window.of(images.explained))
    silhouette = window.of((given[:, COVERAGE].sum(1) > 0).to(given))
    near = attention(silhouette, reach) if silhouette.any() and not everything else torch.ones_like(silhouette)
    weight = window.of(images.weight) * near[:, None]
    certain = window.of(images.certainty) if stage.haze else torch.ones_like(weight)
    return Observation(images, window, maps, weight, certain, predictor.knows_parts, predictor.masked)
