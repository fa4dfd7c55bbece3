"""The paper's objective for one frame: rendered features against observed ones."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..features.extractor import FeatureExtractor
from ..features.hybrid import hybrid
from ..losses import attention, attentional_loss, cosine_similarity, smooth_l1
from ..rendering import Renderer
from ..scene import Scene
from ..settings import OptimizerSettings
from .evaluation import Evaluation
from .inputs import blurred, stacked_images, working_size
from .parameters import ParameterVector
from .window import Window

_SURROUNDINGS = 16
"""What the network sees beyond the attention [px of the working image]."""


class FeatureObjective:
    """Compares a frame's observed features with rendered ones (f_L of the paper).

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
        self.stages = 2
        self.settings = settings
        self.parameters = parameters
        self._extractor = extractor
        width, height = working_size(scene, settings.working_width, extractor.stride)
        self.renderer = Renderer(scene, width=width, height=height, device=extractor.device)
        device = extractor.device
        self._images = stacked_images(scene, images, (width, height), "image").to(device)
        self._background = stacked_images(scene, backgrounds, (width, height), "background").to(device)
        self._window: Window | None = None
        self._observed = self._images

    def _represent(self, images: Tensor) -> Tensor:
        """Features for ACS, predictions for L1."""
        if self.settings.loss == "l1":
            return self._extractor.probability(images)[:, 0]
        return self._extractor.features(images)

    def epoch(self, stage: int) -> int:
        """All losses compare: each is of the final attention."""
        return 0

    def __call__(self, offsets: Float[Tensor, " n"], stage: int, *, gradient: bool) -> Evaluation:
        """Evaluate at the given offsets; stage 0 descends in the wide attention, stage 1 in the final one."""
        settings, wide = self.settings, stage == 0
        unknowns = offsets.detach().clone().requires_grad_(gradient)
        with torch.set_grad_enabled(gradient):
            rendering = self.renderer(self.parameters.state(unknowns))
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
            prior = settings.prior_weight * unknowns.square().sum()
            slope = torch.autograd.grad(value + prior, unknowns)[0] if gradient else torch.zeros_like(offsets)
        return Evaluation(
            value=float((value + prior).detach()),
            loss=float(loss.detach()),
            prior=float(prior.detach()),
            gradient=torch.nan_to_num(slope),
            curvature=None,
            uncertainty=None,
            image=rendering.image.detach(),
            silhouette=rendering.silhouette.detach(),
            similarity=window.paste(similarity.detach(), torch.ones_like(rendering.silhouette)),
            attention=window.paste(used, torch.zeros_like(rendering.silhouette)),
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
