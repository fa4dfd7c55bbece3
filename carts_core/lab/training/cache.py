"""Training images of the surface network on disk, generated once by several processes and read in random order.

A shard is a safetensors file of images of scenes without arms (PNG), and of compressed samples: an image (PNG), its
true surface map, and several prior surface maps from different kinematic errors. It states the robots and the image
settings from which it was generated.
"""

import json
import multiprocessing
import os
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from safetensors import SafetensorError, safe_open

from ...errors import SettingsError, WeightsError
from ...files import output_path, write_bytes
from ...model.parts import SURFACE_CHANNELS
from ...model.robot import Robot
from ...networks.weights import tensor_bytes
from ...settings import TrainingConfig
from ..randomization import SurfaceGenerator, SurfaceSample
from .digests import image_digests

SHARD = 250
"""Images per shard."""
PRIORS = 3
"""Prior surface maps per image."""
SCENES = 100
"""Images of scenes without arms per shard."""
_NICENESS = 5


class ImageCache:
    """Samples of the shards in a folder.

    Raises:
        WeightsError: a shard cannot be read.
    """

    def __init__(self, folder: Path, shards: int) -> None:
        self._files = [_opened(_path(folder, index)) for index in range(shards)]
        self._offsets = [file.get_tensor("offsets").numpy() for file in self._files]

    def __len__(self) -> int:
        return SHARD * len(self._files)

    @property
    def scenes(self) -> int:
        """Number of scenes without arms."""
        return SCENES * len(self._files)

    def scene(self, number: int) -> np.ndarray:
        """Image of a scene without arms, uint8 [h, w, 3]."""
        shard, index = divmod(number, SCENES)
        return _image(*self._parts(shard, [index]))

    def sample(self, number: int, prior: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Image uint8 [h, w, 3], true surface map and one of the prior surface maps, int8 [h, w, 6]."""
        shard, index = divmod(number, SHARD)
        first = SCENES + index * (2 + PRIORS)
        part, *maps = self._parts(shard, [first, first + 1, first + 2 + prior])
        image = _image(part)
        shape = *image.shape[:2], SURFACE_CHANNELS
        truth, given = (np.frombuffer(zlib.decompress(each.tobytes()), np.int8).reshape(shape) for each in maps)
        return image, truth, given

    def _parts(self, shard: int, numbers: list[int]) -> list[np.ndarray]:
        offsets, values = self._offsets[shard], self._files[shard].get_slice("images")
        return [values[int(offsets[number]) : int(offsets[number + 1])].numpy() for number in numbers]


def _image(png: np.ndarray) -> np.ndarray:
    image = cv2.imdecode(png, cv2.IMREAD_COLOR)
    assert image is not None
    return image


def make_cache(
    folder: Path, config: TrainingConfig, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Generate the missing shards of a folder with `config.workers` processes.

    Args:
        progress: called with the number of finished images and the total.

    Raises:
        SettingsError: a shard was generated for other robots or image settings.
        WeightsError: a shard cannot be read.
        RobotError: a robot cannot be loaded.
    """
    wanted, metadata = shards(config.cached), _metadata(config)
    missing = []
    for index in range(wanted):
        path = _path(folder, index)
        if not path.exists():
            missing.append(index)
        # Shards of older versions contain no digests.
        elif {**metadata, **(_opened(path).metadata() or {})} != metadata:
            raise SettingsError(
                f"shard {path} was generated for other robots or image settings. Give another cache folder, or delete "
                "the shards of this one."
            )
    progress((wanted - len(missing)) * SHARD, wanted * SHARD)
    make = partial(_make, folder, config, metadata)
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


def _opened(path: Path) -> Any:
    try:
        return safe_open(path, framework="pt")
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"shard {path} cannot be read ({error}). Delete the file to generate it again.") from error


def _metadata(config: TrainingConfig) -> dict[str, str]:
    """Metadata of a shard, with names and digests of files, so that they can be moved."""
    settings = {"robots": config.robots, "images": asdict(config.images)}
    return {
        "settings": json.dumps(settings, default=lambda path: path.name),
        "digests": json.dumps(image_digests(config)),
    }


def _path(folder: Path, index: int) -> Path:
    return folder / f"samples-{index:05d}.safetensors"


def _prepare() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.nice(_NICENESS)


_ROBOTS: dict[Path, Robot] = {}


def _make(folder: Path, config: TrainingConfig, metadata: dict[str, str], index: int) -> None:
    for path in config.robots:
        if path not in _ROBOTS:
            _ROBOTS[path] = Robot.load(path)
    generator = SurfaceGenerator([_ROBOTS[path] for path in config.robots], config.images, (config.seed, 2, index))
    parts = [_png(generator.scene(number)) for number in range(SCENES)]
    for number in range(SHARD):
        parts += _encoded(generator.samples(number, PRIORS))
    offsets = np.cumsum([0, *map(len, parts)])
    tensors = {
        "images": torch.frombuffer(bytearray(b"".join(parts)), dtype=torch.uint8),
        "offsets": torch.from_numpy(offsets),
    }
    write_bytes(output_path(folder, _path(folder, index).name), tensor_bytes(tensors, metadata))


def _encoded(samples: list[SurfaceSample]) -> list[bytes]:
    maps = [samples[0].surface, *(sample.given for sample in samples)]
    return [_png(samples[0].observed), *(zlib.compress(np.ascontiguousarray(each).tobytes(), 1) for each in maps)]


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
