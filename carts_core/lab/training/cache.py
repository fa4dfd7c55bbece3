"""Training images of the surface network on disk, generated once by several processes, read in random order and
randomly changed.

A shard is a safetensors file of compressed samples: an image (PNG), its true surface map, and several prior surface
maps from different kinematic errors.
"""

import multiprocessing
import os
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from ...errors import WeightsError
from ...files import output_path, write_bytes
from ...model.parts import COVERAGE, NORMALS, SURFACE_CHANNELS
from ...model.robot import Robot
from ...networks.weights import tensor_bytes
from ...settings import TrainingConfig
from ..randomization import SURFACE_UNIT, SurfaceGenerator, SurfaceSample

SHARD = 250
"""Images per shard."""
PRIORS = 3
"""Prior surface maps per image."""
_NICENESS = 5
_CONTRAST, _EXPOSURE, _TINT, _GREY, _NOISY, _NOISE = (0.4, 1.2), (0.8, 1.2), 0.06, 0.1, 0.5, 8.0
_PASTED, _WARPED, _MOVED, _OMITTED = 0.35, 0.5, 0.35, 0.12
"""Shares of samples with arms of a second image, a rotated and enlarged image, a prior that is moved further, and no
prior."""
_ROTATION, _ZOOM = 20.0, (0.95, 1.45)
"""Maximum rotation [deg] and range of the scale [1] of images."""
_ANYWHERE = 0.4
"""Share of crops that are not chosen around an arm."""
_PRIOR_ROTATION, _PRIOR_ZOOM, _PRIOR_SHIFT = 6.0, 0.05, 9.0
"""Standard deviations of the rotation [deg], logarithmic scale [1] and shift [px] of moved priors."""


class ImageCache:
    """Samples of the shards in a folder.

    Raises:
        WeightsError: a shard cannot be read.
    """

    def __init__(self, folder: Path, shards: int) -> None:
        self._files = []
        for index in range(shards):
            path = _path(folder, index)
            try:
                self._files.append(safe_open(path, framework="pt"))
            except (SafetensorError, OSError) as error:
                raise WeightsError(
                    f"shard {path} cannot be read ({error}). Delete the file to generate it again."
                ) from error
        self._offsets = [file.get_tensor("offsets").numpy() for file in self._files]

    def __len__(self) -> int:
        return SHARD * len(self._files)

    def __getitem__(self, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image uint8 [h, w, 3], true surface map and prior surface maps, int8 [h, w, 6] and [priors, h, w, 6]."""
        shard, index = divmod(number, SHARD)
        offsets, values = self._offsets[shard], self._files[shard].get_slice("samples")
        first = index * (2 + PRIORS)
        parts = [
            values[int(offsets[first + k]) : int(offsets[first + k + 1])].numpy().tobytes() for k in range(2 + PRIORS)
        ]
        image = cv2.imdecode(np.frombuffer(parts[0], np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        shape = *image.shape[:2], SURFACE_CHANNELS
        truth, *priors = (np.frombuffer(zlib.decompress(part), np.int8).reshape(shape) for part in parts[1:])
        return image, truth, np.stack(priors)


def make_cache(
    folder: Path, config: TrainingConfig, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Generate the missing shards of a folder with `config.workers` processes.

    Args:
        progress: called with the number of finished images and the total.
    """
    wanted = shards(config.cached)
    missing = [index for index in range(wanted) if not _path(folder, index).exists()]
    progress((wanted - len(missing)) * SHARD, wanted * SHARD)
    make = partial(_make, folder, config)
    with ExitStack() as stack:
        if missing and config.workers:
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(config.workers, _prepare))
            made = pool.imap_unordered(make, missing)
        else:
            made = map(make, missing)
        for done, _ in enumerate(made, start=wanted - len(missing) + 1):
            progress(done * SHARD, wanted * SHARD)


def shards(images: int) -> int:
    """Number of shards for a number of images."""
    return -(-images // SHARD)


def _path(folder: Path, index: int) -> Path:
    return folder / f"images-{index:05d}.safetensors"


def _prepare() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.nice(_NICENESS)


_ROBOTS: dict[Path, Robot] = {}


def _make(folder: Path, config: TrainingConfig, index: int) -> None:
    for path in config.robots:
        if path not in _ROBOTS:
            _ROBOTS[path] = Robot.load(path)
    generator = SurfaceGenerator([_ROBOTS[path] for path in config.robots], config.images, (config.seed, 2, index))
    parts: list[bytes] = []
    for number in range(SHARD):
        samples = generator.samples(number, PRIORS)
        parts += _encoded(samples)
    offsets = np.cumsum([0, *map(len, parts)])
    tensors = {
        "samples": torch.frombuffer(bytearray(b"".join(parts)), dtype=torch.uint8),
        "offsets": torch.from_numpy(offsets),
    }
    write_bytes(output_path(folder, _path(folder, index).name), tensor_bytes(tensors, {}))


def augmented(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Randomize contrast, exposure and white balance of a uint8 RGB image, and sometimes convert it to grey or add
    noise."""
    values = image.astype(np.float32)
    mean = np.array(cv2.mean(image)[:3], np.float32)
    values = mean + (values - mean) * np.float32(rng.uniform(*_CONTRAST))
    values *= (rng.uniform(*_EXPOSURE) * np.clip(rng.normal(1, _TINT, 3), 0.8, 1.2)).astype(np.float32)
    if rng.random() < _GREY:
        values = np.repeat(values.mean(2, keepdims=True), 3, 2)
    if rng.random() < _NOISY:
        values += rng.uniform(0, _NOISE) * rng.standard_normal(values.shape, np.float32)
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def randomized(rng: np.random.Generator, cache: ImageCache, number: int, size: tuple[int, int]) -> SurfaceSample:
    """Crop of a cached image with one of its priors, changed at random: colours, arms of a second image in front,
    rotation and scale, and a moved or removed prior.

    Args:
        size: width and height of the crop [px], at most those of the image.
    """
    sample = _drawn(rng, cache, number)
    if rng.random() < _PASTED:
        sample = pasted(_drawn(rng, cache, int(rng.integers(len(cache)))), sample)
    if rng.random() < _OMITTED:
        sample = replace(sample, given=np.zeros_like(sample.given))
    elif rng.random() < _MOVED:
        sample = replace(sample, given=_moved(rng, sample.given))
    corner = _corner(rng, sample, size)
    if rng.random() >= _WARPED:
        part = tuple(slice(start, start + length) for start, length in zip(corner[::-1], size[::-1], strict=True))
        return SurfaceSample(sample.observed[part], sample.given[part], sample.surface[part])
    centre = corner + np.array(size) / 2
    A = cv2.getRotationMatrix2D(centre.tolist(), rng.uniform(-_ROTATION, _ROTATION), rng.uniform(*_ZOOM))
    A[:, 2] -= corner
    border = rng.uniform(0, 255, 3).tolist() if rng.random() < 0.5 else (0.0, 0.0, 0.0)
    observed = cv2.warpAffine(sample.observed, A, size, borderValue=border)
    return SurfaceSample(observed, warped_map(sample.given, A, size), warped_map(sample.surface, A, size))


def _corner(rng: np.random.Generator, sample: SurfaceSample, size: tuple[int, int]) -> np.ndarray:
    """Upper left corner of a random crop, mostly around a visible or prior arm pixel [px]."""
    last = np.array([whole - part for whole, part in zip(sample.observed.shape[1::-1], size, strict=True)], int)
    chosen = _covered(sample.surface if rng.random() < 0.7 else sample.given)
    pixels = np.flatnonzero(chosen)
    if not len(pixels) or rng.random() < _ANYWHERE:
        return rng.integers(last + 1)
    row, column = divmod(int(pixels[rng.integers(len(pixels))]), chosen.shape[1])
    return np.clip([column, row] - rng.integers(size), 0, last)


def _drawn(rng: np.random.Generator, cache: ImageCache, number: int) -> SurfaceSample:
    image, truth, priors = cache[number]
    return SurfaceSample(augmented(rng, image), priors[rng.integers(len(priors))], truth)


def pasted(front: SurfaceSample, back: SurfaceSample) -> SurfaceSample:
    """Image with the arms of `front` in front of `back`; priors are combined likewise."""
    cover = _cover(front.surface)
    observed = cover * front.observed + (1 - cover) * back.observed
    given, surface = (
        np.rint(ahead + (1 - _cover(ahead)) * behind).astype(np.int8)
        for ahead, behind in ((front.given, back.given), (front.surface, back.surface))
    )
    return SurfaceSample((observed + 0.5).astype(np.uint8), given, surface)


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


def _encoded(samples: list[SurfaceSample]) -> list[bytes]:
    image = cv2.imencode(".png", samples[0].observed, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    maps = [samples[0].surface, *(sample.given for sample in samples)]
    return [image, *(zlib.compress(np.ascontiguousarray(each).tobytes(), 1) for each in maps)]
