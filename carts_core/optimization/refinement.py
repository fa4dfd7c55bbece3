"""Refined masks: rendered masks, corrected near their outline by the coverage that the network predicts.

A rigid model does not reproduce worn, bent or imprecisely modelled instruments exactly, but the network, conditioned on
the final pose, predicts their outline from the image.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from ..model.scene import Scene, SceneState
from ..recording import Frame
from ..settings import SurfaceSolver
from ..settings.stages import Observe
from .observation import Backgrounds, FrameImages, observe
from .predictor import SurfacePredictor

_SCALE = 2.0
"""Size of the observed images relative to the working size, at most that of the camera [1]."""
_BAND = 5.0
"""Distance from the rendered outline beyond which a mask is not refined [px of the working image]."""
_SLOPE = 4.0
"""Slope of the log odds of the rendered mask over the distance from its outline [1/px of the working image]."""
_SURE = 1e-4
"""Lower bound of probabilities predicted by the network [1]."""


@dataclass(frozen=True)
class MaskRefiner:
    """Refiner of rendered masks of the frames of a recording."""

    predictor: SurfacePredictor
    backgrounds: Backgrounds = field(default_factory=lambda: Backgrounds({}))
    """Mean backgrounds of the domain, as in `FrameOptimizer`."""
    settings: SurfaceSolver = field(default_factory=SurfaceSolver)
    """Working size and dehazing."""

    @torch.no_grad()
    def refine(
        self,
        scene: Scene,
        frame: Frame,
        state: SceneState,
        rendered: Mapping[str, Bool[np.ndarray, "height width"]],
        ignore: Mapping[str, Bool[np.ndarray, "height width"]] | None = None,
    ) -> dict[str, Bool[np.ndarray, "height width"]]:
        """Refine the masks of a pose.

        The log odds of a pixel are the sum of those of the network and those of the rendered mask, which are
        proportional to the signed distance from its outline. Pixels farther from the outline than 5 px of the working
        image, ignored pixels and empty masks are not refined.

        Args:
            scene: scene of the frame; only cameras in `rendered` are used.
            frame: frame with the images.
            state: pose of the whole scene.
            rendered: camera name -> rendered mask at the camera's size.
            ignore: camera name -> pixels that show an occluder.

        Returns:
            Refined masks by camera name.

        Raises:
            SettingsError: an image is missing, or the size of an image or mask differs from that of its camera.
        """
        refined, ignore = dict(rendered), ignore or {}
        names = [camera.name for camera in scene.cameras]
        for name, mask in rendered.items():
            if not mask.any():
                continue
            one, index = scene.with_cameras([name]), names.index(name)
            predictor = self.predictor.for_frame(frame, [name])
            images = FrameImages.of(
                one,
                frame.images,
                ignore,
                self.settings,
                predictor,
                scale=_SCALE,
                backgrounds=self.backgrounds if self.backgrounds.covers(one) else None,
            )
            stage = Observe(scale=_SCALE, margin=round(2 * _BAND))
            seen = (
                observe(images, predictor, state.to("cpu").with_camera(index), stage).whole_coverage()[0].cpu().numpy()
            )
            refined[name] = _fused(mask, seen, images.size[0] / images.scale)
            if name in ignore:
                refined[name] = np.where(ignore[name], mask, refined[name])
        return refined


def _fused(
    mask: Bool[np.ndarray, "height width"], coverage: Float[np.ndarray, "h w"], working_width: float
) -> Bool[np.ndarray, "height width"]:
    """Fuse mask and coverage: sum of both log odds near the outline of `mask`."""
    height, width = mask.shape
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance -= cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance *= working_width / width
    share = cv2.resize(coverage, (width, height), interpolation=cv2.INTER_LINEAR).clip(_SURE, 1 - _SURE)
    refined = np.log(share / (1 - share)) + _SLOPE * distance > 0
    return np.where(np.abs(distance) < _BAND, refined, mask)
