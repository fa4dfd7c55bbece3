"""Training frames of the baselines: made once, kept in a folder, shared by all networks that learn from them."""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ...errors import WeightsError
from ...files import OutputPath, holds_file, write_bytes
from ...files.reading import WEIGHTS, check_regular
from ...model.robot import Robot
from ...model.surface import COVERAGE
from ...networks.tensor_bytes import tensor_bytes
from ...resources import shipped_robot
from ...settings import ImageSettings
from ..randomization import SURFACE_UNIT, SurfaceGenerator

SIZE = (256, 192)
"""Width and height of a training frame [px]: a whole image, not a crop."""
IMAGES = ImageSettings(width=SIZE[0], height=SIZE[1], field_width=SIZE[0], occluded=0.0, things=0.0, absent=0.0)
"""Regular images: no smoke, blood or low light, nothing that hides the arms or looks like one, and no arm missing."""
CHUNK = 250
"""Frames of a file."""


class TrainingFrames:
    """Images, what is rendered of kinematics that are a few degrees off, and masks.

    Args:
        folder: with the files that `make_chunk` wrote.
        chunks: numbers of the files.

    Raises:
        WeightsError: a file cannot be read, or holds other frames.
    """

    def __init__(self, folder: OutputPath, chunks: Iterable[int]) -> None:
        parts = [_read(_file(folder, chunk).path) for chunk in chunks]
        self._images, self._given, self._masks = (torch.cat(part) for part in zip(*parts, strict=True))

    def __len__(self) -> int:
        return len(self._images)

    def batch(
        self, numbers: Iterable[int]
    ) -> tuple[UInt8[Tensor, "batch 3 h w"], Float[Tensor, "batch 6 h w"], Float[Tensor, "batch 1 h w"]]:
        """Images, surface maps of the given kinematics, and masks, by their numbers."""
        chosen = list(numbers)
        return (
            self._images[chosen],
            self._given[chosen].float() / SURFACE_UNIT,
            self._masks[chosen].float()[:, None],
        )


def missing_chunks(folder: OutputPath, count: int) -> list[int]:
    """Numbers of the files that have to be made for so many frames."""
    return [chunk for chunk in range(chunks_of(count)) if not holds_file(_file(folder, chunk))]


def chunks_of(count: int) -> int:
    """Files that hold so many frames."""
    return -(-count // CHUNK)


def make_chunk(folder: OutputPath, chunk: int, seed: int, progress: Callable[[int], None] = lambda done: None) -> None:
    """Make one file of frames; it depends on the seed and its number only.

    Args:
        folder: where it is written.
        chunk: its number.
        seed: of all frames.
        progress: is called with the number of frames that are made.

    Raises:
        OutputError: it cannot be written.
    """
    generator = SurfaceGenerator([Robot.load(shipped_robot())], IMAGES, (seed, chunk))
    images, given, masks = [], [], []
    for number in range(CHUNK):
        sample = generator(number)
        images.append(sample.observed.transpose(2, 0, 1))
        given.append(sample.given.transpose(2, 0, 1))
        covered = sample.surface[..., COVERAGE].sum(-1, dtype=np.int16)
        masks.append((2 * covered > SURFACE_UNIT).astype(np.uint8))
        progress(number + 1)
    arrays = {"images": images, "given": given, "masks": masks}
    tensors = {name: torch.from_numpy(np.stack(values)).contiguous() for name, values in arrays.items()}
    write_bytes(_file(folder, chunk), tensor_bytes(tensors, {"settings": _settings(), "seed": str(seed)}))


def _file(folder: OutputPath, chunk: int) -> OutputPath:
    return folder / f"frames_{chunk:03d}.safetensors"


def _settings() -> str:
    return json.dumps(asdict(IMAGES))


def _read(path: Path) -> tuple[Tensor, Tensor, Tensor]:
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="pt") as file:
            if (file.metadata() or {}).get("settings") != _settings():
                raise ValueError("its frames were made with other settings")
            images, given, masks = (file.get_tensor(name) for name in ("images", "given", "masks"))
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(
            f"training frames {path} cannot be read ({error}). Delete the file to have them made again."
        ) from error
    return images, given, masks
