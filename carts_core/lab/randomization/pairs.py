"""Training pairs: an observed image and a hybrid image of nearly the same arms."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Int

from ...model.robot import Robot
from ...model.scene import SceneState
from ...networks.hybrid import hybrid
from ...settings import ImageSettings
from .backgrounds import random_background
from .gbuffer import GBuffer
from .geometry import Intrinsics
from .lens import photograph, tone
from .observer import Observer, look, to_uint8
from .placement import Placement, perturbed
from .variants import Variant

BACKGROUND, SHAFT, HEAD = 0, 1, 2
"""Classes of a pixel: no instrument, its shaft, or what the shaft carries (wrist and jaws)."""

_BLURRED = 0.7
_BLUR = (0.4, 1.8)


@dataclass(frozen=True)
class TrainingPair:
    """An observed image and a hybrid image, each with what it shows."""

    observed: Int[np.ndarray, "h w 3"]
    """RGB uint8."""
    observed_classes: Int[np.ndarray, "h w"]
    """`BACKGROUND`, `SHAFT` or `HEAD` per pixel, uint8."""
    hybrid: Int[np.ndarray, "h w 3"]
    hybrid_classes: Int[np.ndarray, "h w"]


class PairGenerator:
    """Makes training pairs without end; every pair depends on the generator's seed and its number only.

    Args:
        robots: the robots that arms are made of.
        settings: what the pairs look like.
        seed: seed of the random numbers.
    """

    def __init__(self, robots: Sequence[Robot], settings: ImageSettings, seed: int | Sequence[int]) -> None:
        self._observer = Observer(robots, settings, seed)
        self._settings = settings

    def __call__(self, number: int | None = None) -> TrainingPair:
        """The pair of a number, counted from 0; by default the next one."""
        seen = self._observer(number)
        rng, settings = self._observer.rng, self._settings
        rendered = seen.placements
        if rng.random() >= settings.same_kinematics:
            scale = float(rng.uniform(0.3, 2.0))
            pairs = zip(seen.variant.geometries, rendered, strict=True)
            rendered = [perturbed(rng, geometry, placement, scale) for geometry, placement in pairs]
        hybrid_view = look(seen.variant.rendered, rendered, seen.intrinsics, settings.width, settings.height)
        mean_background = self._mean_background(seen.background, seen.camera_seed)
        hybrid_image = self._render_hybrid(seen.variant, rendered, seen.intrinsics, mean_background)
        return TrainingPair(
            to_uint8(seen.image),
            _classes(seen.variant, seen.view, seen.coverage >= 0.5),
            to_uint8(hybrid_image),
            _classes(seen.variant, hybrid_view, None),
        )

    def _mean_background(self, background: np.ndarray, camera_seed: int) -> np.ndarray:
        """BG_m: the scene without arms through the same camera, without its noise; sometimes another scene."""
        rng, appearance = self._observer.rng, self._settings.appearance
        if rng.random() < self._settings.same_background:
            image = photograph(np.random.default_rng(camera_seed), background, appearance)
        else:
            size = self._settings.width, self._settings.height
            image = tone(rng, random_background(rng, *size), appearance).astype(np.float32)
        if rng.random() < 0.8:
            image = cv2.GaussianBlur(image, (0, 0), np.exp(rng.uniform(np.log(0.5), np.log(8))))
        return image

    def _render_hybrid(
        self, variant: Variant, placements: list[Placement], intrinsics: Intrinsics, background: np.ndarray
    ) -> np.ndarray:
        state = SceneState(
            tuple(torch.tensor(placement.joint_positions, dtype=torch.float32) for placement in placements),
            torch.tensor(np.stack([placement.T_camera_base for placement in placements]), dtype=torch.float32),
            torch.eye(4)[None],
            torch.tensor(intrinsics, dtype=torch.float32)[None],
            torch.eye(4)[None],
        )
        with torch.no_grad():
            rendering = variant.renderer(state)
        layers = np.dstack([rendering.image[0].permute(1, 2, 0).numpy(), rendering.silhouette[0].numpy()])
        rng = self._observer.rng
        if rng.random() < _BLURRED:  # as the optimizer does, to have a gradient that reaches further
            layers = cv2.GaussianBlur(layers, (0, 0), rng.uniform(*_BLUR))
        image, silhouette, mean = (
            torch.from_numpy(np.ascontiguousarray(part)) for part in (layers[..., :3], layers[..., 3], background)
        )
        return hybrid(image.permute(2, 0, 1), silhouette, mean.permute(2, 0, 1)).permute(1, 2, 0).numpy()


def _classes(variant: Variant, view: GBuffer, mask: np.ndarray | None) -> np.ndarray:
    """Class per pixel; with `mask`, which is smoother, where an instrument is seen at all."""
    shafts = np.array([geometry.shaft for geometry in variant.geometries])
    classes = view.image(np.where(view.part == shafts[view.arm], SHAFT, HEAD).astype(np.uint8))
    if mask is not None:
        # A pixel that is covered though its centre is not takes the class of a neighbour.
        grown = cv2.dilate(classes, np.ones((3, 3), np.uint8))
        classes = np.where(mask, np.where(classes > 0, classes, np.maximum(grown, SHAFT)), BACKGROUND).astype(np.uint8)
    return classes
