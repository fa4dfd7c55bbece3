"""Training images of the surface network on disk, generated once by several processes and read in random order.

A shard is a safetensors file of compressed samples: an image (PNG), its true surface map, and several prior surface
maps from different kinematic errors.
"""

import multiprocessing
import os
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from ...errors import WeightsError
from ...files import output_path, write_bytes
from ...model.parts import SURFACE_CHANNELS
from ...model.robot import Robot
from ...networks.weights import tensor_bytes
from ...settings import TrainingConfig
from ..randomization import SurfaceGenerator, SurfaceSample

SHARD = 250
"""Images per shard."""
PRIORS = 3
"""Prior surface maps per image."""
_NICENESS = 5


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

    def sample(self, number: int, prior: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image uint8 [h, w, 3], true surface map and one of the prior surface maps, int8 [h, w, 6]."""
        shard, index = divmod(number, SHARD)
        offsets, values = self._offsets[shard], self._files[shard].get_slice("samples")
        first = index * (2 + PRIORS)
        image, *maps = (
            values[int(offsets[k]) : int(offsets[k + 1])].numpy() for k in (first, first + 1, first + 2 + prior)
        )
        decoded = cv2.imdecode(image, cv2.IMREAD_COLOR)
        assert decoded is not None
        shape = *decoded.shape[:2], SURFACE_CHANNELS
        truth, given = (np.frombuffer(zlib.decompress(part), np.int8).reshape(shape) for part in maps)
        return decoded, truth, given


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


def _encoded(samples: list[SurfaceSample]) -> list[bytes]:
    image = cv2.imencode(".png", samples[0].observed, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
    maps = [samples[0].surface, *(sample.given for sample in samples)]
    return [image, *(zlib.compress(np.ascontiguousarray(each).tobytes(), 1) for each in maps)]
