"""Optimization problem of the paper: losses between observed and rendered features."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from ..imaging.working_image import Window, attention, blurred, stacked_images, working_size
from ..model.scene import Scene
from ..networks.extractor import FeatureExtractor, hybrid
from ..rendering import Renderer
from ..settings import DescentSolver, Loss
from ..settings.stages import FirstOrder, Observe, Stage
from ..threads import one_thread
from .observability import Evaluation
from .variables import Variables

_EMPTY = 1e-6


def cosine_similarity(
    observed: Float[Tensor, "*batch channels h w"], rendered: Float[Tensor, "*batch channels h w"]
) -> Float[Tensor, "*batch h w"]:
    """Cosine similarity along the channels (sim_cos of the paper); two zero features count as equal."""
    dot = (observed * rendered).sum(-3)
    norms = (observed.square().sum(-3) + _EMPTY).sqrt() * (rendered.square().sum(-3) + _EMPTY).sqrt()
    return (dot + _EMPTY) / norms


@one_thread()
def attentional_loss(
    similarity: Float[Tensor, "*batch h w"],
    weight: Float[Tensor, "*batch h w"],
    loss: Loss,
    pixels: int | None = None,
) -> Float[Tensor, "*batch"]:
    """ACS loss of the paper (equation for L) in one of its variants, per image.

    Args:
        similarity: similarity of features, at most 1.
        weight: attention map, in [0, 1].
        pixels: number of pixels w x h of the whole image, if the maps are a window that contains all attention.
    """
    pixels = pixels or similarity.shape[-2] * similarity.shape[-1]
    if loss == "acs_paper":
        return 1.0 - (similarity * weight).sum((-2, -1)) / pixels
    if loss == "acs_reference":
        return ((1.0 - similarity) * weight).sum((-2, -1)) / pixels
    area = weight.sum((-2, -1)).clamp(min=1.0)
    return ((1.0 - similarity) * weight).sum((-2, -1)) / area


@one_thread()
def smooth_l1(observed: Float[Tensor, "*batch h w"], rendered: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch"]:
    """Smooth L1 between predicted probabilities, over the whole image ("CaRTS L1"), per image."""
    return functional.smooth_l1_loss(rendered, observed, reduction="none", beta=0.1).mean((-2, -1))


_SURROUNDINGS = 16
"""Margin of the network's input around the attention [px of the working image]."""


class FeatureProblem:
    """Compares a frame's observed features with rendered ones (f_L of the paper).

    Args:
        backgrounds: camera name -> mean background BG_m, at the camera's image size.

    Raises:
        SettingsError: an image or background is missing, or its size differs from that of its camera.
    """

    def __init__(
        self,
        scene: Scene,
        images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        backgrounds: Mapping[str, UInt8[np.ndarray, "h w 3"]],
        extractor: FeatureExtractor,
        variables: Variables,
        settings: DescentSolver,
    ) -> None:
        self.settings = settings
        self.variables = variables
        self._extractor = extractor
        width, height = working_size(scene, settings.working_width, extractor.stride)
        self.renderer = Renderer(scene, width=width, height=height, device=extractor.device)
        device = extractor.device
        self._images = stacked_images(scene, images, (width, height), "image").to(device)
        self._background = stacked_images(scene, backgrounds, (width, height), "background").to(device)
        self._window: Window | None = None
        self._observed = self._images

    def _represent(self, images: Tensor) -> Tensor:
        """Representation of images that is compared: network features for ACS, predictions for L1."""
        if self.settings.loss is Loss.L1:
            return self._extractor.probability(images)[:, 0]
        return self._extractor.features(images)

    def observe(self, stage: Observe, offsets: Float[Tensor, " n"]) -> None:
        """No-op: observed features are computed on the first comparison of a window."""

    def objective_key(self, blur: float) -> tuple[int, float]:
        """Key of the objective; constant, since all losses use the final attention and are comparable."""
        return 0, 0.0

    @property
    def final(self) -> FirstOrder:
        """The last stage, whose attention is used for the losses of all stages, so that they are comparable."""
        stage = self.settings.stages[-1]
        assert isinstance(stage, FirstOrder)
        return stage

    def evaluate(self, offsets: Float[Tensor, " n"], stage: Stage, *, gradient: bool = True) -> Evaluation:
        """Evaluate a point under the attention of a stage."""
        assert isinstance(stage, FirstOrder)
        settings, final = self.settings, self.final
        wide = stage.attention > final.attention
        unknowns = offsets.detach().clone().requires_grad_(gradient)
        with torch.set_grad_enabled(gradient):
            rendering = self.renderer(self.variables.state(unknowns))
            window = self._observed_around(rendering.silhouette.detach(), stage.attention)
            silhouette = window.of(rendering.silhouette)
            layers = torch.cat([window.of(rendering.image), silhouette[:, None]], 1)
            layers = blurred(layers, stage.blur)
            represented = self._represent(hybrid(layers[:, :3], layers[:, 3], window.of(self._background)))
            fine = attention(silhouette, final.attention)
            if settings.loss is Loss.L1:
                similarity = 1.0 - (represented - self._observed).abs()
                value = smooth_l1(self._observed, represented).mean()
                loss, used = value, fine
            else:
                pixels = self.renderer.width * self.renderer.height
                similarity = cosine_similarity(self._observed, represented)
                used = attention(silhouette, stage.attention) if wide else fine
                value = attentional_loss(similarity, used, settings.loss, pixels).mean()
                loss = attentional_loss(similarity.detach(), fine, settings.loss, pixels).mean() if wide else value
            prior = settings.prior_weight * unknowns.square().sum()
            slope = torch.autograd.grad(value + prior, unknowns)[0] if gradient else torch.zeros_like(offsets)
        return Evaluation(
            value=float((value + prior).detach()),
            loss=float(loss.detach()),
            stage_loss=float(value.detach()),
            gradient=torch.nan_to_num(slope),
            hessian=None,
            uncertainty=None,
            image=rendering.image.detach(),
            silhouette=rendering.silhouette.detach(),
            similarity=window.paste(similarity.detach(), torch.ones_like(rendering.silhouette)),
            attention=window.paste(used, torch.zeros_like(rendering.silhouette)),
        )

    def _observed_around(self, silhouette: Float[Tensor, "cameras h w"], radius: int) -> Window:
        """Window that is compared: the area of the attention, with a margin for the network.

        The window changes only if it no longer contains the attention or has become much too large, so that observed
        features are rarely recomputed.
        """
        size = (self.renderer.width, self.renderer.height)
        if self.settings.loss is Loss.L1:
            wanted = tight = Window(0, 0, *size)
        else:
            tight = Window.around(silhouette, radius, 1, size)
            wanted = Window.around(silhouette, radius + _SURROUNDINGS, self._extractor.stride, size)
        outgrown = self._window is not None and self._window.area > 1.5 * wanted.area
        if self._window is None or outgrown or not self._window.holds(tight):
            self._window = wanted
            with torch.no_grad():
                self._observed = self._represent(wanted.of(self._images))
        return self._window
