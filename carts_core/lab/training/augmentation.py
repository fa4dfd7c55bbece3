"""Random changes of cached training images of the surface network."""

from dataclasses import replace

import cv2
import numpy as np

from ...model.parts import COVERAGE, NORMALS
from ..randomization import SURFACE_UNIT, SurfaceSample
from .cache import PRIORS, ImageCache

_CONTRAST = 0.4, 1.2
"""Range of the factor of differences from the mean colour [1]."""
_EXPOSURE, _TINT = (1.0, 1.25), 0.06
"""Range of the exposure factor [1], at least 1 because images may already have `DARKEST_BRIGHTNESS`; standard deviation
of the factors of single channels [1]."""
_GREY, _NOISY = 0.1, 0.5
"""Shares of grey images and of images with added noise."""
_NOISE = 8.0
"""Maximum standard deviation of added noise [8-bit values]."""
_ELSEWHERE, _ABSENT = 0.42, 0.12
"""Shares of samples whose arms are pasted into another scene, and of scenes without arms."""
_PASTED, _WARPED, _MOVED, _OMITTED = 0.35, 0.5, 0.45, 0.12
"""Shares of samples with arms of a second image, a rotated and enlarged image, a prior that is moved further, and no
prior."""
_SHADOWED, _SHADOW = 0.5, 0.98
"""Share of images with a further shadow of the arms, and its maximum darkness [1]."""
_SHADOW_SHIFT, _SHADOW_BLUR = (1.5, 25.0), (0.3, 9.0)
"""Ranges of the shift and of the blur of such shadows [px]. Close, sharp and dark ones resemble a shaft."""
_ROTATION, _ZOOM = 20.0, (0.95, 1.45)
"""Maximum rotation [deg] and range of the scale [1] of images."""
_ANYWHERE = 0.5
"""Share of crops that are not chosen around an arm."""
_VISIBLE = 0.7
"""Share of the other crops that are chosen around visible arms, instead of those of the prior."""
_PRIOR_ROTATION, _PRIOR_ZOOM, _PRIOR_SHIFT = 8.0, 0.08, 14.0
"""Standard deviations of the rotation [deg], logarithmic scale [1] and shift [px] of moved priors."""


def augmented(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Randomize contrast, exposure and white balance of a uint8 RGB image, and sometimes convert it to grey."""
    mean = np.array(cv2.mean(image)[:3])
    contrast, gains = rng.uniform(*_CONTRAST), rng.uniform(*_EXPOSURE) * np.clip(rng.normal(1, _TINT, 3), 0.8, 1.2)
    table = gains * (mean + contrast * (np.arange(256)[:, None] - mean))
    changed = cv2.LUT(image, np.clip(table + 0.5, 0, 255).astype(np.uint8)[None])
    if rng.random() < _GREY:
        changed = cv2.cvtColor(cv2.transform(changed, np.full((1, 3), 1 / 3)), cv2.COLOR_GRAY2RGB)
    return changed


def noisy(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Sometimes add Gaussian noise to a uint8 image."""
    if rng.random() >= _NOISY:
        return image
    noise = np.float32(rng.uniform(0, _NOISE)) * rng.standard_normal(image.shape, np.float32)
    return np.clip(image + noise + np.float32(0.5), 0, 255).astype(np.uint8)


def randomized(rng: np.random.Generator, cache: ImageCache, number: int, size: tuple[int, int]) -> SurfaceSample:
    """Crop of a cached image with one of its priors, changed at random: colours, another scene, arms of a second image
    in front, rotation and scale, and a moved or removed prior.

    Args:
        size: width and height of the crop [px], at most those of the image.
    """
    sample = shaded(rng, _drawn(rng, cache, number))
    if rng.random() < _PASTED:
        front = _drawn(rng, cache, int(rng.integers(len(cache))))
        sample = pasted(front, shadowed(rng, sample, front.surface))
    if rng.random() < _OMITTED:
        sample = replace(sample, given=np.zeros_like(sample.given))
    elif rng.random() < _MOVED:
        sample = replace(sample, given=_moved(rng, sample.given))
    corner = _corner(rng, sample, size)
    if rng.random() >= _WARPED:
        part = tuple(slice(start, start + length) for start, length in zip(corner[::-1], size[::-1], strict=True))
        return SurfaceSample(noisy(rng, sample.observed[part]), sample.given[part], sample.surface[part])
    centre = corner + np.array(size) / 2
    A = cv2.getRotationMatrix2D(centre.tolist(), rng.uniform(-_ROTATION, _ROTATION), rng.uniform(*_ZOOM))
    A[:, 2] -= corner
    border = rng.uniform(0, 255, 3).tolist() if rng.random() < 0.5 else (0.0, 0.0, 0.0)
    observed = cv2.warpAffine(sample.observed, A, size, borderValue=border)
    return SurfaceSample(noisy(rng, observed), warped_map(sample.given, A, size), warped_map(sample.surface, A, size))


def _corner(rng: np.random.Generator, sample: SurfaceSample, size: tuple[int, int]) -> np.ndarray:
    """Upper left corner of a random crop, mostly around a visible or prior arm pixel [px]."""
    last = np.array([whole - part for whole, part in zip(sample.observed.shape[1::-1], size, strict=True)], int)
    chosen = _covered(sample.surface if rng.random() < _VISIBLE else sample.given)
    pixels = np.flatnonzero(chosen)
    if not len(pixels) or rng.random() < _ANYWHERE:
        return rng.integers(last + 1)
    row, column = divmod(int(pixels[rng.integers(len(pixels))]), chosen.shape[1])
    return np.clip([column, row] - rng.integers(size), 0, last)


def _drawn(rng: np.random.Generator, cache: ImageCache, number: int) -> SurfaceSample:
    """Sample with its own scene, with another scene, or without its arms."""
    image, truth, given = cache.sample(number, int(rng.integers(PRIORS)))
    sample, chance = SurfaceSample(augmented(rng, image), given, truth), rng.random()
    if chance >= _ELSEWHERE + _ABSENT:
        return sample
    scene, nothing = augmented(rng, cache.scene(int(rng.integers(cache.scenes)))), np.zeros_like(truth)
    if chance < _ABSENT:
        return SurfaceSample(scene, given, nothing)
    return pasted(sample, shadowed(rng, SurfaceSample(scene, nothing, nothing), truth))


def pasted(front: SurfaceSample, back: SurfaceSample) -> SurfaceSample:
    """Image with the arms of `front` in front of `back`; priors are combined likewise."""
    cover = _cover(front.surface)
    observed = cover * front.observed + (1 - cover) * back.observed
    given, surface = (
        np.rint(ahead + (1 - _cover(ahead)) * behind).astype(np.int8)
        for ahead, behind in ((front.given, back.given), (front.surface, back.surface))
    )
    return SurfaceSample((observed + 0.5).astype(np.uint8), given, surface)


def shaded(rng: np.random.Generator, sample: SurfaceSample) -> SurfaceSample:
    """Image that sometimes has a further shadow of its own arms, which falls beside them only."""
    changed, cover = shadowed(rng, sample, sample.surface), _cover(sample.surface)
    if changed is sample:
        return sample
    observed = cover * sample.observed + (1 - cover) * changed.observed
    return replace(sample, observed=(observed + 0.5).astype(np.uint8))


def shadowed(rng: np.random.Generator, sample: SurfaceSample, surface: np.ndarray) -> SurfaceSample:
    """Image that sometimes has a shadow of the arms of a surface map: their silhouette, shifted and blurred."""
    if rng.random() >= _SHADOWED:
        return sample
    shift, heading = np.exp(rng.uniform(*np.log(_SHADOW_SHIFT))), rng.uniform(0, 2 * np.pi)
    A = np.column_stack([np.eye(2), shift * np.array([np.cos(heading), np.sin(heading)])])
    shadow = cv2.warpAffine(_cover(surface), A, surface.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
    blurred = cv2.GaussianBlur(shadow, (0, 0), np.exp(rng.uniform(*np.log(_SHADOW_BLUR))))
    # Dark ones are more frequent: they are the most similar to a shaft.
    light = 1 - np.float32(_SHADOW * np.sqrt(rng.random())) * blurred[..., None]
    return replace(sample, observed=(sample.observed * light + np.float32(0.5)).astype(np.uint8))


def _cover(surface: np.ndarray) -> np.ndarray:
    """Share of each pixel that arms cover [h, w, 1]."""
    return np.minimum(_covered(surface).astype(np.float32) / SURFACE_UNIT, 1)[..., None]


def _covered(surface: np.ndarray) -> np.ndarray:
    """Sum of the coverage of all parts, int16 [h, w]."""
    # Faster than a sum over the last, short axis.
    first, *others = np.moveaxis(surface[..., COVERAGE], -1, 0)
    total = first.astype(np.int16)
    for part in others:
        total += part
    return total


def warped_map(surface: np.ndarray, A: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Surface map of width and height `size` [px] under a similarity transform of the image [2, 3], which rotates
    normals about the optical axis."""
    values = surface.astype(np.float32)
    warped = np.dstack(
        [cv2.warpAffine(np.ascontiguousarray(values[..., part]), A, size) for part in (COVERAGE, NORMALS)]
    )
    turn = A[:, :2] / np.sqrt(np.linalg.det(A[:, :2]))
    flat = slice(NORMALS.start, NORMALS.start + 2)
    warped[..., flat] = warped[..., flat] @ turn.T.astype(np.float32)
    return np.rint(warped).astype(np.int8)


def _moved(rng: np.random.Generator, given: np.ndarray) -> np.ndarray:
    """Prior surface map, rotated about the centre of the visible arms, scaled and shifted at random."""
    rows, columns = np.nonzero(_covered(given))
    if not len(rows):
        return given
    centre = float(columns.mean()), float(rows.mean())
    A = cv2.getRotationMatrix2D(centre, rng.normal(0, _PRIOR_ROTATION), np.exp(rng.normal(0, _PRIOR_ZOOM)))
    A[:, 2] += rng.normal(0, _PRIOR_SHIFT, 2)
    return warped_map(given, A, given.shape[1::-1])
