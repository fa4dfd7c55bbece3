"""Observations: images of a frame at the size of comparison, and the surface maps predicted from them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..imaging.haze import certainty, dehazed, transmission
from ..imaging.working_image import Window, attention, pixel_weights, stacked_images, working_size
from ..model.parts import COVERAGE
from ..model.scene import Scene, SceneState
from ..rendering import Renderer
from ..settings import SurfaceSolver
from ..settings.stages import Observe
from ..threads import total
from .backgrounds import DECEPTIVE, Backgrounds, Change, without_background
from .predictor import FramePredictor

HAS_LEFT = 0.3
"""Share of its initial area below which an arm has left the image [1]."""


@dataclass(frozen=True)
class FrameImages:
    """Images at one size, with pixel weights. Created by `FrameImages.of`."""

    scale: float
    """Size relative to the working image [1]."""
    size: tuple[int, int]
    """Width and height [px]."""
    images: Float[Tensor, "cameras 3 h w"]
    """RGB in [0, 1], without smoke and haze."""
    weight: Float[Tensor, "cameras 1 h w"]
    """Pixel weight: 0 at known occluders, 1 elsewhere."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """Information of a pixel, relative to an image without smoke and haze [1]."""
    explained: Float[Tensor, "cameras 1 h w"] | None
    """Share of the predicted coverage explained by the empty background [1]; None if unknown."""
    change: Change | None
    """Difference from the empty background; None if that is unknown."""
    renderer: Renderer
    """Renderer of the whole image."""

    def area_alone(self, state: SceneState, arm: int) -> int:
        """Number of pixels of an arm in all images, without occlusion by other arms."""
        whole = self.renderer.scene
        scene = whole.with_arms([whole.arms[arm].name])
        renderer = Renderer(scene, width=self.size[0], height=self.size[1], device=self.renderer.device)
        alone = replace(
            state,
            joint_positions=(state.joint_positions[arm],),
            T_world_base=state.T_world_base[..., arm : arm + 1, :, :],
        )
        return int((renderer.segment(alone) >= 0).sum())

    def still_in_view(
        self,
        arm: int,
        before: tuple[Int[np.ndarray, "cameras h w"], SceneState],
        after: tuple[Int[np.ndarray, "cameras h w"], SceneState],
    ) -> float:
        """Ratio of an arm's area after and before [1], from labels and state of each; occluded parts count."""
        share = int((after[0] == arm).sum()) / max(int((before[0] == arm).sum()), 1)
        if share >= HAS_LEFT or len(self.renderer.scene.arms) < 2:
            return share
        return self.area_alone(after[1], arm) / max(self.area_alone(before[1], arm), 1)

    @property
    def replaced(self) -> bool:
        """Whether the unchanged background was replaced in the images."""
        return self.change is not None and self.explained is None

    @staticmethod
    def of(
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        settings: SurfaceSolver,
        predictor: FramePredictor,
        *,
        scale: float = 1.0,
        backgrounds: Backgrounds | None = None,
        replaced: bool | None = None,
    ) -> "FrameImages":
        """Prepare images at `scale` times the working size, rounded to the predictor's stride.

        Args:
            ignore: camera name -> pixels that show an occluder.
            settings: working size and dehazing.
            predictor: image sizes are multiples of its stride; it is also run once on the backgrounds.
            scale: image size relative to the working size [1].
            replaced: whether unchanged background is replaced before prediction; otherwise predictions in the
                background are subtracted. By default it is replaced where it causes false detections.

        Raises:
            SettingsError: an image is missing, or the size of an image or mask differs from that of its camera.
        """
        unit, _ = working_size(scene, settings.working_width, predictor.stride)
        size = working_size(scene, round(settings.working_width * scale), predictor.stride)
        stacked = stacked_images(scene, images, size, "image").to(predictor.device)
        # Given masks require neither dehazing nor a background.
        through = transmission(stacked, settings.dehaze if predictor.knows_parts else 0.0)
        explained, change = None, None
        if not predictor.masked and backgrounds is not None and backgrounds.covers(scene):
            background = backgrounds.at(scene, size, settings.dehaze, predictor)
            change = background.compared(stacked, size[0] / unit)
            deceptive = total(background.seen) / background.seen.numel() > DECEPTIVE
            if deceptive if replaced is None else replaced:
                stacked, through = without_background(stacked, change.surely, size[0] / unit), torch.ones_like(through)
            else:
                explained = background.seen * (1.0 - change.surely)
        return FrameImages(
            scale=size[0] / unit,
            size=size,
            images=dehazed(stacked, through),
            weight=pixel_weights(scene, ignore, size).to(predictor.device),
            # Smoke affects the network more than noise: docs/explanation/decisions.md.
            certainty=torch.ones_like(through) if predictor.masked else certainty(through).square(),
            explained=explained,
            change=change,
            renderer=Renderer(scene, width=size[0], height=size[1], device=predictor.device),
        )


@dataclass(frozen=True)
class Observation:
    """Predicted surface maps in a window of the images, with weights of their pixels."""

    images: FrameImages
    """The observed images."""
    window: Window
    """Observed part of the images [px of these images]."""
    maps: Float[Tensor, "cameras 6 h w"]
    """Surface maps predicted in the window."""
    weight: Float[Tensor, "cameras 1 h w"]
    """Weight of each pixel: 0 far from the arms and at known occluders."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """Information of a pixel, relative to an image without smoke and haze [1]."""
    knows_parts: bool = True
    """Whether parts and normals are predicted in addition to the coverage of the whole arm."""
    masked: bool = False
    """Whether the coverage comes from given masks."""

    @property
    def coverage(self) -> Float[Tensor, "cameras h w"]:
        """Coverage of all arms, in the window."""
        return self.maps[:, COVERAGE].sum(1)

    @cached_property
    def area(self) -> float:
        """Weighted area of the predicted arms [px of the working image]."""
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
    """Predict surface maps conditioned on a state, around its arms or in the whole image."""
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
