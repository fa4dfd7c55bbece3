"""Training samples: pairs of observed and hybrid images (feature network), and surface maps (surface network)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from ...model.parts import COVERAGE, NORMALS, SURFACE_CHANNELS
from ...model.robot import Robot
from ...model.scene import SceneState
from ...networks.extractor import hybrid
from ...settings import ImageSettings
from .arms import (
    Intrinsics,
    Placement,
    RecordedPlacements,
    RobotGeometry,
    Variant,
    perturbed,
    random_chain,
    random_intrinsics,
    random_placement,
    random_variant,
)
from .backgrounds import Photographs, random_background
from .clutter import add_clutter, add_objects, bleed, cast_shadow, contact_shadow, occlude
from .shading import GBuffer, photograph, render_gbuffer, shade, tone

SUPERSAMPLING = 2
_VARIANTS = 12
_VARIANT_LIFE = 80
"""Number of images after which the next entry of the pool is renewed."""
_OBSERVATIONS, _SCENES, _EMPTY = 0, 1, 2
"""Indices of the random streams."""
_TISSUE = 0.6
"""Minimum share of tissue among scenes without arms."""
_TRIES = 12
_FAR = 100.0
"""Distance behind the camera at which absent arms are placed [m]."""
_CONTACT = 0.4
"""Share of images with a sharp shadow beside the arms."""


@dataclass(frozen=True)
class Observation:
    """Observed image with its scene."""

    image: Float[np.ndarray, "h w 3"]
    """RGB in [0, 1]."""
    variant: Variant
    placements: list[Placement]
    """Poses of the arms."""
    claimed: list[Placement]
    """Prior poses of the arms, equal to the true poses except for absent arms."""
    intrinsics: Intrinsics
    view: GBuffer
    """Surface points at the pixel centres."""
    fine: GBuffer
    """Surface points at `SUPERSAMPLING` times the resolution."""
    coverage: Float[np.ndarray, "h w"]
    """Share of each pixel that shows an arm."""
    background: Float[np.ndarray, "h w 3"]
    """Scene without arms, before camera effects."""
    camera_seed: int
    """Seed of the camera effects."""


class Observer:
    """Generator of observed images; an image depends only on the seed and its number."""

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
        """Generate observation `number`, counted from 0; by default, the next one."""
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
            view = render_view(variant.geometries, placements, intrinsics, size)
        fine = render_view(variant.geometries, placements, intrinsics, size, SUPERSAMPLING)
        coverage = cv2.resize(fine.image(np.ones(len(fine.rows), np.float32)), size, interpolation=cv2.INTER_AREA)
        background = self._background(intrinsics, *size)
        camera_seed = int(rng.integers(2**63))
        image = self._observe(variant, fine, background, coverage, camera_seed)
        return Observation(
            image, variant, placements, claimed, intrinsics, view, fine, coverage, background, camera_seed
        )

    def scene(self, number: int) -> Float[np.ndarray, "h w 3"]:
        """Image `number` of a scene without arms."""
        self.rng = rng = np.random.default_rng((*self._seed, _EMPTY, number))
        size = self.settings.width, self.settings.height
        intrinsics = random_intrinsics(rng, *size, self.settings.field_width)
        return photograph(rng, self._background(intrinsics, *size, _TISSUE), self.settings.appearance)

    def _variant(self, arms: int, number: int) -> Variant:
        """Scene from a small pool with gradual renewal, since creating a scene takes as long as several images."""
        place, settings = int(self.rng.integers(_VARIANTS)), self.settings
        # One entry of the pool is renewed at a time.
        life = number // _VARIANT_LIFE + place
        generation = life // _VARIANTS
        variant, made = self._variants.get((arms, place), (None, -1))
        if variant is None or made != generation:
            rng = np.random.default_rng((*self._seed, _SCENES, arms, place, generation))
            chain = rng.random() < settings.chains
            robots = [random_chain(rng)] if chain else self._robots
            variant = random_variant(rng, robots, 1 if chain else arms, settings.width, settings.height)
        self._variants[arms, place] = variant, generation
        return variant

    def _visible_placements(self, variant: Variant) -> tuple[Intrinsics, list[Placement], GBuffer]:
        """Draw placements until the visible area of the arms is within bounds, for at most `_TRIES` times."""
        settings, rng = self.settings, self.rng
        size = settings.width, settings.height
        tries = 0
        while True:
            field = settings.field_width
            if rng.random() < settings.enlarged:
                field = round(field * float(rng.uniform(1.0, 2.0)))
            if self._recorded is not None:
                intrinsics, placements = self._recorded(rng, variant.geometries, size, field)
            else:
                intrinsics = random_intrinsics(rng, *size, field)
                placements = self._placed(variant, intrinsics, size)
            view = render_view(variant.geometries, placements, intrinsics, size)
            share = len(view.rows) / (settings.width * settings.height)
            tries += 1
            if settings.coverage[0] <= share <= settings.coverage[1] or tries == _TRIES:
                return intrinsics, placements, view

    def _placed(self, variant: Variant, intrinsics: Intrinsics, size: tuple[int, int]) -> list[Placement]:
        """Random placements; the second arm often crosses the first."""
        rng, geometries = self.rng, variant.geometries
        placements = [random_placement(rng, geometries[0], intrinsics, *size)]
        for geometry in geometries[1:]:
            near = None
            if rng.random() < self.settings.crossing:
                view = render_view(geometries[:1], placements[:1], intrinsics, size)
                if len(view.points):
                    near = view.points[rng.integers(len(view.points))].astype(float)
            placements.append(random_placement(rng, geometry, intrinsics, *size, near))
        return placements

    def _without_some(self, placements: list[Placement]) -> list[Placement]:
        """Placements with one or all of the arms moved behind the camera."""
        gone = self.rng.random(len(placements)) < 0.5
        if not gone.any():
            gone[:] = True
        behind = np.eye(4)
        behind[2, 3] = -_FAR
        return [
            replace(placement, T_camera_base=behind @ placement.T_camera_base) if away else placement
            for placement, away in zip(placements, gone, strict=True)
        ]

    def _background(
        self, intrinsics: Intrinsics, width: int, height: int, tissue: float = 0.0
    ) -> Float[np.ndarray, "h w 3"]:
        rng, settings = self.rng, self.settings
        if self._photographs is not None and rng.random() < settings.from_photographs:
            image = self._photographs(rng, width, height)
        else:
            image = add_clutter(rng, random_background(rng, width, height, tissue))
        if rng.random() < settings.things:
            image = add_objects(rng, image, intrinsics)
        return image.astype(np.float32)

    def _observe(
        self, variant: Variant, fine: GBuffer, background: np.ndarray, coverage: np.ndarray, camera_seed: int
    ) -> Float[np.ndarray, "h w 3"]:
        rng = self.rng
        color = shade(rng, fine, list(variant.geometries), background.mean((0, 1)))
        # Averaging the shaded subpixels yields premultiplied colour, as compositing requires.
        arms = cv2.resize(fine.image(color.astype(np.float32)), coverage.shape[::-1], interpolation=cv2.INTER_AREA)
        for _ in range(rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])):
            background = cast_shadow(rng, background, coverage)
        if rng.random() < _CONTACT and (coverage > 0.5).any():
            background = contact_shadow(rng, background, coverage, float(np.median(arms[coverage > 0.5])))
        composed = background * (1 - coverage[..., None]) + arms
        if rng.random() < self.settings.occluded:
            composed = occlude(rng, composed, coverage)
        if rng.random() < self.settings.blood:
            composed = bleed(rng, composed, coverage)
        return photograph(np.random.default_rng(camera_seed), composed, self.settings.appearance)


def render_view(
    arms: Sequence[RobotGeometry],
    placements: Sequence[Placement],
    intrinsics: Intrinsics,
    size: tuple[int, int],
    fine: int = 1,
) -> GBuffer:
    """G-buffer of placed arms in an image of width and height `size` [px], at `fine` times the resolution."""
    posed = [
        arm.posed(placement.T_camera_base @ arm.link_transforms(placement.joint_positions))
        for arm, placement in zip(arms, placements, strict=True)
    ]
    fx, fy, cx, cy = (value * fine for value in intrinsics)
    return render_gbuffer(arms, posed, (fx, fy, cx, cy), size[0] * fine, size[1] * fine)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Convert an image in [0, 1] to bytes."""
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


BACKGROUND, SHAFT, HEAD = 0, 1, 2
"""Pixel classes: no instrument, shaft, or wrist and jaws."""

_BLURRED = 0.7
_BLUR = (0.4, 1.8)


@dataclass(frozen=True)
class TrainingPair:
    """Observed image and hybrid image, each with the classes of its pixels."""

    observed: Int[np.ndarray, "h w 3"]
    """RGB uint8."""
    observed_classes: Int[np.ndarray, "h w"]
    """`BACKGROUND`, `SHAFT` or `HEAD` per pixel, uint8."""
    hybrid: Int[np.ndarray, "h w 3"]
    hybrid_classes: Int[np.ndarray, "h w"]


class PairGenerator:
    """Generator of training pairs; a pair depends only on the seed and its number."""

    def __init__(self, robots: Sequence[Robot], settings: ImageSettings, seed: int | Sequence[int]) -> None:
        self._observer = Observer(robots, settings, seed)
        self._settings = settings

    def __call__(self, number: int | None = None) -> TrainingPair:
        """Generate training pair `number`, counted from 0; by default, the next one."""
        seen = self._observer(number)
        rng, settings = self._observer.rng, self._settings
        rendered = seen.placements
        if rng.random() >= settings.same_kinematics:
            scale = float(rng.uniform(0.3, 2.0))
            pairs = zip(seen.variant.geometries, rendered, strict=True)
            rendered = [perturbed(rng, geometry, placement, scale) for geometry, placement in pairs]
        hybrid_view = render_view(seen.variant.rendered, rendered, seen.intrinsics, (settings.width, settings.height))
        mean_background = self._mean_background(seen.background, seen.camera_seed)
        hybrid_image = self._render_hybrid(seen.variant, rendered, seen.intrinsics, mean_background)
        return TrainingPair(
            to_uint8(seen.image),
            _classes(seen.variant, seen.view, seen.coverage >= 0.5),
            to_uint8(hybrid_image),
            _classes(seen.variant, hybrid_view, None),
        )

    def _mean_background(self, background: np.ndarray, camera_seed: int) -> np.ndarray:
        """Mean background BG_m, often blurred: the observed scene without arms, or sometimes another scene."""
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
        if rng.random() < _BLURRED:  # as in the optimizer, to widen the gradient's support
            layers = cv2.GaussianBlur(layers, (0, 0), rng.uniform(*_BLUR))
        image, silhouette, mean = (
            torch.from_numpy(np.ascontiguousarray(part)) for part in (layers[..., :3], layers[..., 3], background)
        )
        return hybrid(image.permute(2, 0, 1), silhouette, mean.permute(2, 0, 1)).permute(1, 2, 0).numpy()


def _classes(variant: Variant, view: GBuffer, mask: np.ndarray | None) -> np.ndarray:
    """Class per pixel, adapted to `mask` (an antialiased instrument mask) if given."""
    shafts = np.array([geometry.shaft for geometry in variant.geometries])
    classes = view.image(np.where(view.part == shafts[view.arm], SHAFT, HEAD).astype(np.uint8))
    if mask is not None:
        # Pixels of the mask with an uncovered centre have the class of a neighbour.
        grown = cv2.dilate(classes, np.ones((3, 3), np.uint8))
        classes = np.where(mask, np.where(classes > 0, classes, np.maximum(grown, SHAFT)), BACKGROUND).astype(np.uint8)
    return classes


SURFACE_UNIT = 127
"""Scale of surface maps stored as int8 in samples."""

_MAX_ERROR = 3.0
"""Maximum scale of the error of the prior kinematics; 1 is about 3 degrees and 3 mm."""

_UNKNOWN = 0.08
"""Share of samples without prior kinematics."""


@dataclass(frozen=True)
class SurfaceSample:
    """Training sample of the surface network; see `carts_core.model.parts` for surface maps."""

    observed: Int[np.ndarray, "h w 3"]
    """RGB uint8."""
    given: Int[np.ndarray, "h w 6"]
    """Prior surface map from erroneous kinematics, times `SURFACE_UNIT`, int8."""
    surface: Int[np.ndarray, "h w 6"]
    """True surface map of the image, times `SURFACE_UNIT`, int8."""


class SurfaceGenerator:
    """Generator of surface samples; a sample depends only on the seed and its number."""

    def __init__(self, robots: Sequence[Robot], settings: ImageSettings, seed: int | Sequence[int]) -> None:
        self._observer = Observer(robots, settings, seed)

    def __call__(self, number: int | None = None) -> SurfaceSample:
        """Generate surface sample `number`, counted from 0; by default, the next one."""
        return self.samples(number, 1)[0]

    def scene(self, number: int) -> Int[np.ndarray, "h w 3"]:
        """Image `number` of a scene without arms, RGB uint8."""
        return to_uint8(self._observer.scene(number))

    def samples(self, number: int | None, priors: int) -> list[SurfaceSample]:
        """Generate samples of one image with `priors` different prior surface maps."""
        seen = self._observer(number)
        size = self._observer.settings.width, self._observer.settings.height
        image, surface = to_uint8(seen.image), _surface(seen.variant.geometries, seen.fine, size)
        return [SurfaceSample(image, self._prior(seen, size), surface) for _ in range(priors)]

    def _prior(self, seen: Observation, size: tuple[int, int]) -> np.ndarray:
        """Prior surface map from erroneous kinematics, or zeros."""
        rng = self._observer.rng
        # Small errors are frequent, so that the network learns to be accurate.
        scale = _MAX_ERROR * float(rng.random()) ** 1.5
        given = [
            perturbed(rng, geometry, placement, scale)
            for geometry, placement in zip(seen.variant.rendered, seen.claimed, strict=True)
        ]
        wrong = _surface(seen.variant.rendered, render_view(seen.variant.rendered, given, seen.intrinsics, size), size)
        return np.zeros_like(wrong) if rng.random() < _UNKNOWN else wrong


def _surface(geometries: Sequence[RobotGeometry], view: GBuffer, size: tuple[int, int]) -> np.ndarray:
    """Surface map of arms as int8, from a G-buffer at the given size or a multiple of it."""
    values = np.zeros((len(view.rows), SURFACE_CHANNELS), np.float32)
    for index, geometry in enumerate(geometries):
        mine = np.flatnonzero(view.arm == index)
        values[mine, COVERAGE.start + geometry.part_class[view.part[mine]]] = 1.0
    values[:, NORMALS] = view.normals
    return np.rint(cv2.resize(view.image(values), size, interpolation=cv2.INTER_AREA) * SURFACE_UNIT).astype(np.int8)
