"""Whether a network knows these arms and this kind of image, before anything is solved."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..imaging.window import Window
from ..model.parts import COVERAGE, SURFACE_CHANNELS
from ..model.scene import Scene
from ..networks.extractor import FeatureExtractor
from ..recording import Frame
from ..settings import SurfaceSolver
from .frame_images import FrameImages
from .losses import attention
from .predictor import SurfacePredictor, predictor_of

_TISSUE = 0.75, 0.55, 0.45
"""What arms are rendered before, RGB."""

_NEAR = 40
"""How far from the arms as measured predictions count as theirs [px of the working image]."""

RECOGNIZED, _ELSEWHERE = 0.95, 0.05
"""Overlap from which a rendering is recognized as those of training are, and share of an image beyond which predictions
mislead [1]."""

UNKNOWN_ROBOT_REMEDY = "Give masks (--observe masks, or both), or train for this recording (`carts train`, --weights)."


def overlap_below_usual(overlap: float) -> str:
    """Text on an overlap below `RECOGNIZED`, rounded down so that it reads as less."""
    return f"an overlap of {math.floor(1000 * overlap) / 1000:.3f} only ({RECOGNIZED} or more is usual)"


@dataclass(frozen=True)
class Familiarity:
    """How well a network knows arms and images, from one frame."""

    recognized: float | None
    """Overlap (soft Dice) of what the network predicts of a rendering of the arms before plain tissue, conditioned on
    nothing, with the arms that were rendered [1]; None where no arm is in view."""
    elsewhere: float
    """Share of the image, far from the arms as measured, that the network takes for arms [1]."""

    def warnings(self, where: str, remedy: str = UNKNOWN_ROBOT_REMEDY, *, background: bool = False) -> list[str]:
        """What people should know before they solve; nothing where all is well.

        Args:
            where: says which images are meant.
            remedy: what to do where the network does not know arms or images.
            background: whether the empty background is known; then what is taken for arms in it does no harm.
        """
        found = []
        if self.recognized is None:
            place = "Check T_camera_world, T_world_base and the units of the joints."
            found.append(f"{where}: no arm is in view as measured. {place}")
        elif self.recognized < RECOGNIZED:
            found.append(
                f"{where}: the network recognizes a rendering of these arms with "
                f"{overlap_below_usual(self.recognized)}, so it may not know this robot at this distance. {remedy}"
            )
        if self.elsewhere > _ELSEWHERE and not background:
            found.append(
                f"{where}: the network takes {100 * self.elsewhere:.0f} % of the image for arms where none can be, and "
                f"the empty background is not known. {remedy}"
            )
        return found


@torch.no_grad()
def familiarity(
    scene: Scene, frame: Frame, networks: FeatureExtractor | SurfacePredictor, settings: SurfaceSolver | None = None
) -> Familiarity:
    """Try a network on a frame; it predicts twice.

    Args:
        scene: with the cameras that take part.
        frame: images and measured joint positions.
        networks: the networks, or another predictor of surface maps.
        settings: working size, and how much haze is taken off.

    Raises:
        SettingsError: an image is missing, or of another size than its camera.
    """
    settings = settings or SurfaceSolver()
    predictor = predictor_of(networks).for_frame(frame, [camera.name for camera in scene.cameras])
    images = FrameImages.of(
        scene,
        frame.images,
        {},
        scale=1.0,
        working_width=settings.working_width,
        dehaze=settings.dehaze,
        predictor=predictor,
    )
    rendered = images.renderer(scene.state(frame.measured, predictor.device, frame.mounts))
    nothing = images.images.new_zeros(len(images.images), SURFACE_CHANNELS, *images.images.shape[-2:])
    whole = Window(0, 0, *images.size)

    def covered(pictures: Tensor) -> Tensor:
        return predictor.predict(pictures, nothing, whole)[:, COVERAGE].sum(1, keepdim=True).clamp(0.0, 1.0)

    arms = rendered.silhouette[:, None]
    tissue = torch.tensor(_TISSUE, device=arms.device)[:, None, None]
    overlap = None
    if bool(arms.any()):
        seen = covered(rendered.image * arms + tissue * (1.0 - arms))
        overlap = float(2.0 * torch.minimum(seen, arms).sum() / (seen.sum() + arms.sum()))
    far = 1.0 - attention((arms > 0).to(arms), round(_NEAR * images.scale))
    return Familiarity(overlap, float((covered(images.images) * far).mean()))
