"""Observed training images: random arms in front of a random camera, shaded and photographed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from ...model.robot import Robot
from ...settings import ImageSettings
from .backgrounds import random_background
from .clutter import add_clutter, cast_shadow, contact_shadow
from .gbuffer import GBuffer, render_gbuffer
from .geometry import Intrinsics, RobotGeometry
from .lens import photograph
from .occluders import occlude
from .photographs import Photographs
from .placement import Placement, random_intrinsics, random_placement
from .recorded import RecordedPlacements
from .shading import shade
from .things import add_things
from .variants import Variant, random_variant

SUPERSAMPLING = 2
_VARIANTS = 12
_VARIANT_LIFE = 80
"""How many images are made before another place of the pool is renewed."""
_OBSERVATIONS, _SCENES = 0, 1
"""Streams of random numbers."""
_TRIES = 12
_FAR = 100.0
"""How far behind the camera an arm is that is not there [m]."""
_CONTACT = 0.4
"""Share of images with a crisp shadow beside the arms."""


@dataclass(frozen=True)
class Observation:
    """An observed image and everything that it was made of."""

    image: Float[np.ndarray, "h w 3"]
    """RGB in [0, 1]."""
    variant: Variant
    placements: list[Placement]
    """Where the arms are."""
    claimed: list[Placement]
    """Where arms are said to be: the same, but for arms that are not there."""
    intrinsics: Intrinsics
    view: GBuffer
    """What each pixel's centre sees."""
    fine: GBuffer
    """The same, `SUPERSAMPLING` times as fine."""
    coverage: Float[np.ndarray, "h w"]
    """Share of each pixel that shows an arm."""
    background: Float[np.ndarray, "h w 3"]
    """Without arms, before the camera."""
    camera_seed: int
    """Seed of what the camera did to the image."""


class Observer:
    """Makes observed images without end; each depends on the seed and its number only.

    Args:
        robots: the robots that arms are made of.
        settings: what the images look like.
        seed: seed of the random numbers.
    """

    def __init__(self, robots: Sequence[Robot], settings: ImageSettings, seed: int | Sequence[int]) -> None:
        self._seed = (seed,) if isinstance(seed, int) else tuple(seed)
        self._next = 0
        self.rng = np.random.default_rng(self._seed)
        self.settings = settings
        self._robots = robots
        self._photographs = Photographs(settings.photographs) if settings.photographs else None
        self._recorded = RecordedPlacements(settings.recording) if settings.recording else None
        self._variants: dict[tuple[int, int], tuple[Variant, int]] = {}

    def __call__(self, number: int | None = None) -> Observation:
        """The observation of a number, counted from 0; by default the next one."""
        number = self._next if number is None else number
        self._next = number + 1
        self.rng = np.random.default_rng((*self._seed, _OBSERVATIONS, number))
        rng, settings = self.rng, self.settings
        variant = self._variant(1 + int(rng.random() < settings.two_arms), number)
        size = settings.width, settings.height
        intrinsics, claimed, view = self._visible_placements(variant)
        placements = claimed
        if rng.random() < settings.absent:
            placements = self._without_some(claimed)
            view = look(variant.geometries, placements, intrinsics, *size)
        fine = look(variant.geometries, placements, intrinsics, *size, SUPERSAMPLING)
        coverage = cv2.resize(fine.image(np.ones(len(fine.rows), np.float32)), size, interpolation=cv2.INTER_AREA)
        background = self._background(intrinsics, *size)
        camera_seed = int(rng.integers(2**63))
        image = self._observe(variant, fine, background, coverage, camera_seed)
        return Observation(
            image, variant, placements, claimed, intrinsics, view, fine, coverage, background, camera_seed
        )

    def _variant(self, arms: int, number: int) -> Variant:
        """A scene from a small pool, replaced now and then: building one costs as much as several images."""
        place, settings = int(self.rng.integers(_VARIANTS)), self.settings
        # One place of the pool is renewed at a time.
        life = number // _VARIANT_LIFE + place
        generation = life // _VARIANTS
        variant, made = self._variants.get((arms, place), (None, -1))
        if variant is None or made != generation:
            rng = np.random.default_rng((*self._seed, _SCENES, arms, place, generation))
            variant = random_variant(rng, self._robots, arms, settings.width, settings.height)
        self._variants[arms, place] = variant, generation
        return variant

    def _visible_placements(self, variant: Variant) -> tuple[Intrinsics, list[Placement], GBuffer]:
        """Arms of which the camera sees neither too little nor too much; after some tries, whatever it sees."""
        settings, rng = self.settings, self.rng
        size = settings.width, settings.height
        tries = 0
        while True:
            if self._recorded is not None:
                intrinsics, placements = self._recorded(rng, variant.geometries, size, settings.field_width)
            else:
                intrinsics = random_intrinsics(rng, *size, settings.field_width)
                placements = [random_placement(rng, geometry, intrinsics, *size) for geometry in variant.geometries]
            view = look(variant.geometries, placements, intrinsics, *size)
            share = len(view.rows) / (settings.width * settings.height)
            tries += 1
            if settings.coverage[0] <= share <= settings.coverage[1] or tries == _TRIES:
                return intrinsics, placements, view

    def _without_some(self, placements: list[Placement]) -> list[Placement]:
        """One of the arms, or all, moved behind the camera."""
        gone = self.rng.random(len(placements)) < 0.5
        if not gone.any():
            gone[:] = True
        behind = np.eye(4)
        behind[2, 3] = -_FAR
        return [
            replace(placement, T_camera_base=behind @ placement.T_camera_base) if away else placement
            for placement, away in zip(placements, gone, strict=True)
        ]

    def _background(self, intrinsics: Intrinsics, width: int, height: int) -> Float[np.ndarray, "h w 3"]:
        rng, settings = self.rng, self.settings
        if self._photographs is not None and rng.random() < settings.from_photographs:
            image = self._photographs(rng, width, height)
        else:
            image = add_clutter(rng, random_background(rng, width, height))
        if rng.random() < settings.things:
            image = add_things(rng, image, intrinsics)
        return image.astype(np.float32)

    def _observe(
        self, variant: Variant, fine: GBuffer, background: np.ndarray, coverage: np.ndarray, camera_seed: int
    ) -> Float[np.ndarray, "h w 3"]:
        rng = self.rng
        color = shade(rng, fine, list(variant.geometries), background.mean((0, 1)))
        # Averaging the shaded subpixels gives colour times coverage, which is what compositing needs.
        arms = cv2.resize(fine.image(color.astype(np.float32)), coverage.shape[::-1], interpolation=cv2.INTER_AREA)
        for _ in range(rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])):
            background = cast_shadow(rng, background, coverage)
        if rng.random() < _CONTACT and (coverage > 0.5).any():
            background = contact_shadow(rng, background, coverage, float(np.median(arms[coverage > 0.5])))
        composed = background * (1 - coverage[..., None]) + arms
        if rng.random() < self.settings.occluded:
            composed = occlude(rng, composed, coverage)
        return photograph(np.random.default_rng(camera_seed), composed, self.settings.appearance)


def look(
    geometries: Sequence[RobotGeometry],
    placements: Sequence[Placement],
    intrinsics: Intrinsics,
    width: int,
    height: int,
    supersampling: int = 1,
) -> GBuffer:
    """What the camera sees of placed arms."""
    posed = [
        geometry.posed(placement.T_camera_base @ geometry.link_transforms(placement.joint_positions))
        for geometry, placement in zip(geometries, placements, strict=True)
    ]
    fx, fy, cx, cy = intrinsics
    scaled = fx * supersampling, fy * supersampling, cx * supersampling, cy * supersampling
    return render_gbuffer(geometries, posed, scaled, width * supersampling, height * supersampling)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """An image in [0, 1] as bytes."""
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
