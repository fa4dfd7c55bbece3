"""The images of a frame in a size in which they are compared."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..imaging.haze import certainty, dehazed, transmission
from ..model.scene import Scene, SceneState
from ..rendering import Renderer
from .counterfactual import Backgrounds, Change, without_background
from .inputs import pixel_weights, stacked_images, working_size
from .predictor import FramePredictor

HAS_LEFT = 0.3
"""Share of its area at the start below which an arm has left the image [1]."""


@dataclass(frozen=True)
class FrameImages:
    """Images in one size, and what their pixels are worth. Made by `FrameImages.of`."""

    scale: float
    """How many times larger than the working image [1]."""
    size: tuple[int, int]
    """Width and height [px]."""
    images: Float[Tensor, "cameras 3 h w"]
    """RGB in [0, 1], without smoke and haze."""
    weight: Float[Tensor, "cameras 1 h w"]
    """0 where an occluder is known to be, 1 elsewhere."""
    certainty: Float[Tensor, "cameras 1 h w"]
    """Information of a pixel, as a share of what it would have without smoke and haze [1]."""
    explained: Float[Tensor, "cameras 1 h w"] | None
    """Share of the predicted coverage that is predicted in the empty background, too [1]; None where not known."""
    change: Change | None
    """What differs from the empty background; None where that is not known."""
    renderer: Renderer
    """Of the whole image."""

    def area_alone(self, state: SceneState, arm: int) -> int:
        """Pixels that an arm covers in all images where no other arm hides it.

        Args:
            state: of the scene.
            arm: its position in the scene.
        """
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
        """Share of an arm's area at the start that it still has [1]; what another arm hides is in view.

        Args:
            arm: its position in the scene.
            before, after: arm of each pixel and state, at the start and now.
        """
        share = int((after[0] == arm).sum()) / max(int((before[0] == arm).sum()), 1)
        if share >= HAS_LEFT or len(self.renderer.scene.arms) < 2:
            return share
        return self.area_alone(after[1], arm) / max(self.area_alone(before[1], arm), 1)

    @property
    def replaced(self) -> bool:
        """Whether the empty background was replaced in the images."""
        return self.change is not None and self.explained is None

    @staticmethod
    def of(
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        ignore: Mapping[str, Bool[np.ndarray, "h w"]],
        *,
        scale: float,
        working_width: int,
        dehaze: float,
        predictor: FramePredictor,
        backgrounds: Backgrounds | None = None,
        replaced: bool | None = None,
    ) -> "FrameImages":
        """Images at `scale` times the working size, as far as the predictor's stride allows.

        Args:
            scene: with the cameras that take part.
            images: camera name -> observed RGB image.
            ignore: camera name -> pixels that show an occluder.
            scale: times the working size [1].
            working_width: width of the working image [px].
            dehaze: share of smoke and haze that is taken off [1].
            predictor: sizes are multiples of its stride; it also sees the backgrounds, once.
            backgrounds: of the cameras, where they are known.
            replaced: whether what has not changed against them is replaced before the predictor sees it; else what it
                also sees in them is taken off. By default it is where they would deceive it.

        Raises:
            SettingsError: an image is missing, or an image or a mask is of another size than its camera.
        """
        unit, _ = working_size(scene, working_width, predictor.stride)
        size = working_size(scene, round(working_width * scale), predictor.stride)
        stacked = stacked_images(scene, images, size, "image").to(predictor.device)
        # Given masks know through haze, and before any background, where arms are.
        through = transmission(stacked, dehaze if predictor.knows_parts else 0.0)
        explained, change = None, None
        if not predictor.masked and backgrounds is not None and backgrounds.covers(scene):
            background = backgrounds.at(scene, size, dehaze, predictor)
            change = background.compared(stacked, size[0] / unit)
            if background.deceptive if replaced is None else replaced:
                stacked, through = without_background(stacked, change.surely, size[0] / unit), torch.ones_like(through)
            else:
                explained = background.seen * (1.0 - change.surely)
        return FrameImages(
            scale=size[0] / unit,
            size=size,
            images=dehazed(stacked, through),
            weight=pixel_weights(scene, ignore, size).to(predictor.device),
            # Smoke misleads the network by more than noise does: docs/explanation/decisions.md.
            certainty=torch.ones_like(through) if predictor.masked else certainty(through).square(),
            explained=explained,
            change=change,
            renderer=Renderer(scene, width=size[0], height=size[1], device=predictor.device),
        )
