"""Training pairs: an observed image and a hybrid image of nearly the same arms."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from ...errors import SettingsError
from ...robot import Robot
from ...scene import SceneState
from ..hybrid import hybrid
from .backgrounds import random_background
from .clutter import add_clutter, cast_shadow
from .gbuffer import GBuffer, render_gbuffer
from .geometry import Intrinsics, RobotGeometry
from .lens import photograph, tone
from .placement import Placement, perturbed, random_intrinsics, random_placement
from .ranges import AppearanceRanges
from .shading import shade
from .variants import Variant, random_variant

BACKGROUND, SHAFT, HEAD = 0, 1, 2
"""Classes of a pixel: no instrument, its shaft, or what the shaft carries (wrist and jaws)."""

_SUPERSAMPLING = 2
_VARIANTS = 12
_VARIANT_LIFE = 40
_TRIES = 12
_BLURRED = 0.7
_BLUR = (0.4, 1.8)


@dataclass(frozen=True)
class PairSettings:
    """What training pairs look like."""

    width: int = 192
    """Width of a training image [px]."""
    height: int = 160
    """Height of a training image [px]."""
    field_width: int = 320
    """Width [px] of the camera image that a training image is a crop of; focal lengths refer to it."""
    two_arms: float = 0.4
    """Share of pairs with two arms."""
    same_kinematics: float = 0.5
    """Share of pairs whose hybrid image shows exactly the kinematics of the observed one."""
    same_background: float = 0.7
    """Share of pairs whose mean background is that of the observed image."""
    coverage: tuple[float, float] = (0.004, 0.5)
    """Allowed share of the image that shows arms."""
    appearance: AppearanceRanges = field(default_factory=AppearanceRanges)
    """The camera's ranges."""

    def __post_init__(self) -> None:
        if self.width % 16 or self.height % 16 or min(self.width, self.height) <= 0:
            raise SettingsError(
                f"training images of {self.width}x{self.height} px; give positive multiples of 16 for both."
            )
        if self.field_width < self.width:
            raise SettingsError(f"field_width is {self.field_width}; give at least the width, {self.width}.")
        for name in ("two_arms", "same_kinematics", "same_background"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(f"{name} is {getattr(self, name)}; give a share from 0 to 1.")
        if not 0 <= self.coverage[0] < self.coverage[1] <= 1:
            raise SettingsError(f"coverage is {self.coverage}; give two shares, the lower one first.")


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
    """Makes training pairs without end; every pair depends on the generator's seed and the pairs before it only.

    Args:
        robots: the robots that arms are made of.
        settings: what the pairs look like.
        seed: seed of the random numbers.
    """

    def __init__(self, robots: Sequence[Robot], settings: PairSettings, seed: int | Sequence[int]) -> None:
        self._robots = robots
        self._settings = settings
        self._rng = np.random.default_rng(seed)
        self._variants: dict[tuple[int, int], tuple[Variant, int]] = {}

    def __call__(self) -> TrainingPair:
        """The next pair."""
        rng, settings = self._rng, self._settings
        variant = self._variant(1 + int(rng.random() < settings.two_arms))
        size = settings.width, settings.height
        intrinsics, placements, view = self._visible_placements(variant)
        fine = _look(variant.geometries, placements, intrinsics, *size, _SUPERSAMPLING)
        coverage = cv2.resize(fine.image(np.ones(len(fine.rows), np.float32)), size, interpolation=cv2.INTER_AREA)
        background = add_clutter(rng, random_background(rng, *size)).astype(np.float32)
        camera_seed = int(rng.integers(2**63))
        observed = self._observe(variant, fine, background, coverage, camera_seed)
        rendered = placements
        if rng.random() >= settings.same_kinematics:
            scale = float(rng.uniform(0.3, 2.0))
            pairs = zip(variant.geometries, placements, strict=True)
            rendered = [perturbed(rng, geometry, placement, scale) for geometry, placement in pairs]
        hybrid_view = _look(variant.rendered, rendered, intrinsics, *size)
        mean_background = self._mean_background(background, camera_seed)
        hybrid_image = self._render_hybrid(variant, rendered, intrinsics, mean_background)
        return TrainingPair(
            _to_uint8(observed),
            _classes(variant, view, coverage >= 0.5),
            _to_uint8(hybrid_image),
            _classes(variant, hybrid_view, None),
        )

    def _variant(self, arms: int) -> Variant:
        """A scene from a small pool, replaced after some use: building one costs as much as several images."""
        key = arms, int(self._rng.integers(_VARIANTS))
        variant, uses = self._variants.get(key, (None, 0))
        if variant is None or uses >= _VARIANT_LIFE:
            settings = self._settings
            variant, uses = random_variant(self._rng, self._robots, arms, settings.width, settings.height), 0
        self._variants[key] = variant, uses + 1
        return variant

    def _visible_placements(self, variant: Variant) -> tuple[Intrinsics, list[Placement], GBuffer]:
        """Arms of which the camera sees neither too little nor too much; after some tries, whatever it sees."""
        settings, rng = self._settings, self._rng
        size = settings.width, settings.height
        tries = 0
        while True:
            intrinsics = random_intrinsics(rng, *size, settings.field_width)
            placements = [random_placement(rng, geometry, intrinsics, *size) for geometry in variant.geometries]
            view = _look(variant.geometries, placements, intrinsics, *size)
            share = len(view.rows) / (settings.width * settings.height)
            tries += 1
            if settings.coverage[0] <= share <= settings.coverage[1] or tries == _TRIES:
                return intrinsics, placements, view

    def _observe(
        self, variant: Variant, fine: GBuffer, background: np.ndarray, coverage: np.ndarray, camera_seed: int
    ) -> Float[np.ndarray, "h w 3"]:
        rng = self._rng
        color = shade(rng, fine, list(variant.geometries), background.mean((0, 1)))
        # Averaging the shaded subpixels gives colour times coverage, which is what compositing needs.
        arms = cv2.resize(fine.image(color.astype(np.float32)), coverage.shape[::-1], interpolation=cv2.INTER_AREA)
        for _ in range(rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])):
            background = cast_shadow(rng, background, coverage)
        composed = background * (1 - coverage[..., None]) + arms
        return photograph(np.random.default_rng(camera_seed), composed, self._settings.appearance)

    def _mean_background(self, background: np.ndarray, camera_seed: int) -> np.ndarray:
        """BG_m: the scene without arms through the same camera, without its noise; sometimes another scene."""
        rng, appearance = self._rng, self._settings.appearance
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
        )
        with torch.no_grad():
            rendering = variant.renderer(state)
        layers = np.dstack([rendering.image[0].permute(1, 2, 0).numpy(), rendering.silhouette[0].numpy()])
        if self._rng.random() < _BLURRED:  # as the optimizer does, to have a gradient that reaches further
            layers = cv2.GaussianBlur(layers, (0, 0), self._rng.uniform(*_BLUR))
        image, silhouette, mean = (
            torch.from_numpy(np.ascontiguousarray(part)) for part in (layers[..., :3], layers[..., 3], background)
        )
        return hybrid(image.permute(2, 0, 1), silhouette, mean.permute(2, 0, 1)).permute(1, 2, 0).numpy()


def _look(
    geometries: Sequence[RobotGeometry],
    placements: Sequence[Placement],
    intrinsics: Intrinsics,
    width: int,
    height: int,
    supersampling: int = 1,
) -> GBuffer:
    posed = [
        geometry.posed(placement.T_camera_base @ geometry.link_transforms(placement.joint_positions))
        for geometry, placement in zip(geometries, placements, strict=True)
    ]
    fx, fy, cx, cy = intrinsics
    scaled = fx * supersampling, fy * supersampling, cx * supersampling, cy * supersampling
    return render_gbuffer(geometries, posed, scaled, width * supersampling, height * supersampling)


def _classes(variant: Variant, view: GBuffer, mask: np.ndarray | None) -> np.ndarray:
    """Class per pixel; with `mask`, which is smoother, where an instrument is seen at all."""
    shafts = np.array([geometry.shaft for geometry in variant.geometries])
    classes = view.image(np.where(view.part == shafts[view.arm], SHAFT, HEAD).astype(np.uint8))
    if mask is not None:
        # A pixel that is covered though its centre is not takes the class of a neighbour.
        grown = cv2.dilate(classes, np.ones((3, 3), np.uint8))
        classes = np.where(mask, np.where(classes > 0, classes, np.maximum(grown, SHAFT)), BACKGROUND).astype(np.uint8)
    return classes


def _to_uint8(image: np.ndarray) -> np.ndarray:
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
