"""The objective f_L of the paper for one frame: offsets in, loss and everything worth looking at out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from kornia.filters import gaussian_blur2d
from torch import Tensor

from ..errors import SettingsError
from ..features.extractor import FeatureExtractor
from ..features.hybrid import hybrid
from ..losses import attention, attentional_loss, cosine_similarity, smooth_l1
from ..rendering import Renderer, Rendering
from ..scene import Scene
from .parameters import ParameterVector
from .settings import OptimizerSettings
from .window import Window

_SURROUNDINGS = 16
"""What the network sees beyond the attention [px of the working image]."""


@dataclass(frozen=True)
class Evaluation:
    """The objective at one point."""

    objective: Tensor
    """What is descended, with gradient: the loss in the present attention, and the prior."""
    loss: float
    """The loss in the final attention, which is comparable through all iterations."""
    prior: float
    rendering: Rendering
    similarity: Float[Tensor, "cameras h w"]
    """1 outside the window that was compared."""
    attention: Float[Tensor, "cameras h w"]


class FrameObjective:
    """Compares a frame's observed features with rendered ones.

    Args:
        scene: with the cameras that take part.
        images: camera name -> observed RGB image.
        backgrounds: camera name -> mean background BG_m, of the same size.
        extractor: the feature network.
        parameters: the unknowns.
        settings: loss, attention and working size.

    Raises:
        SettingsError: an image or a background is missing, or of another size than its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        extractor: FeatureExtractor,
        parameters: ParameterVector,
        settings: OptimizerSettings,
    ) -> None:
        self.settings = settings
        self.parameters = parameters
        self._extractor = extractor
        width, height = working_size(scene, settings.working_width, extractor.stride)
        self.renderer = Renderer(scene, width=width, height=height, device=extractor.device)
        self._images = self._stack(scene, images, "image")
        self._background = self._stack(scene, backgrounds, "background")
        self._window: Window | None = None
        self._observed = self._images

    def _stack(self, scene: Scene, images: Mapping[str, np.ndarray], what: str) -> Float[Tensor, "cameras 3 h w"]:
        resized = []
        for camera in scene.cameras:
            if camera.name not in images:
                raise SettingsError(f"no {what} of camera {camera.name!r} was given; given are: {', '.join(images)}.")
            image = images[camera.name]
            if image.shape != (camera.height, camera.width, 3):
                raise SettingsError(
                    f"the {what} of camera {camera.name!r} has shape {image.shape}, but its camera says "
                    f"({camera.height}, {camera.width}, 3)."
                )
            size = (self.renderer.width, self.renderer.height)
            resized.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
        stacked = torch.from_numpy(np.stack(resized)).to(self._extractor.device)
        return stacked.permute(0, 3, 1, 2).float() / 255.0

    def _represent(self, images: Tensor) -> Tensor:
        """Features for ACS, predictions for L1."""
        if self.settings.loss == "l1":
            return self._extractor.probability(images)[:, 0]
        return self._extractor.features(images)

    def __call__(self, offsets: Float[Tensor, " n"], *, wide: bool) -> Evaluation:
        """Evaluate at the given offsets.

        Args:
            offsets: unknowns, with or without gradient.
            wide: descend in the wide attention (coarse) and not in the final one (fine).
        """
        settings = self.settings
        rendering = self.renderer(self.parameters.state(offsets))
        window = self._look_at(rendering.silhouette.detach(), wide)
        silhouette = window.of(rendering.silhouette)
        layers = torch.cat([window.of(rendering.image), silhouette[:, None]], 1)
        layers = blurred(layers, settings.wide_blur if wide else settings.blur)
        represented = self._represent(hybrid(layers[:, :3], layers[:, 3], window.of(self._background)))
        fine = attention(silhouette, settings.attention_radius)
        if settings.loss == "l1":
            similarity = 1.0 - (represented - self._observed).abs()
            value = smooth_l1(self._observed, represented).mean()
            loss, used = value, fine
        else:
            pixels = self.renderer.width * self.renderer.height
            similarity = cosine_similarity(self._observed, represented)
            used = attention(silhouette, settings.wide_attention_radius) if wide else fine
            value = attentional_loss(similarity, used, settings.loss, pixels).mean()
            loss = attentional_loss(similarity.detach(), fine, settings.loss, pixels).mean() if wide else value
        prior = settings.prior_weight * offsets.square().sum()
        return Evaluation(
            value + prior,
            float(loss.detach()),
            float(prior.detach()),
            rendering,
            window.paste(similarity.detach(), torch.ones_like(rendering.silhouette)),
            window.paste(used, torch.zeros_like(rendering.silhouette)),
        )

    def _look_at(self, silhouette: Float[Tensor, "cameras h w"], wide: bool) -> Window:
        """The window that is compared: all that the attention covers, with some surroundings for the network.

        It stays where it is as long as it holds the attention, so that observed features are computed once.
        """
        size = (self.renderer.width, self.renderer.height)
        if self.settings.loss == "l1":
            wanted = tight = Window(0, 0, *size)
        else:
            radius = self.settings.wide_attention_radius if wide else self.settings.attention_radius
            tight = Window.around(silhouette, radius, 1, size)
            wanted = Window.around(silhouette, radius + _SURROUNDINGS, self._extractor.stride, size)
        outgrown = self._window is not None and self._window.area > 1.5 * wanted.area
        if self._window is None or outgrown or not self._window.holds(tight):
            self._window = wanted
            with torch.no_grad():
                self._observed = self._represent(wanted.of(self._images))
        return self._window


def blurred(images: Float[Tensor, "n channels h w"], deviation: float) -> Float[Tensor, "n channels h w"]:
    """Images under a Gaussian of that deviation [px]; 0 leaves them as they are."""
    if deviation == 0:
        return images
    size = 2 * math.ceil(2.5 * deviation) + 1
    return gaussian_blur2d(images, (size, size), (deviation, deviation), border_type="replicate")


def working_size(scene: Scene, width: int, stride: int) -> tuple[int, int]:
    """Width and height [px] of the compared images: the first camera's shape, in multiples of the network's stride."""
    camera = scene.cameras[0]
    width = max(round(min(width, camera.width) / stride), 1) * stride
    return width, max(round(width * camera.height / camera.width / stride), 1) * stride
