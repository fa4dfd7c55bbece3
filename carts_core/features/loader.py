"""Training batches, made in worker processes while the network trains."""

import os
from collections import deque
from collections.abc import Iterator

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from ..robot import Robot
from .domain_randomization import PairGenerator, TrainingPair
from .training_config import TrainingConfig

VALIDATION_STREAM = 1
_TRAINING_STREAM = 0
_NICENESS = 1
_MEMORY = 64


class _PairDataset(IterableDataset):
    """An endless stream of pairs; each worker and each start of training has its own."""

    def __init__(self, config: TrainingConfig, first_step: int) -> None:
        self._config = config
        self._first_step = first_step

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        info = get_worker_info()
        worker = 0
        if info is not None:
            worker = info.id
            # One thread per process: the processes themselves fill the cores. Training itself goes first.
            torch.set_num_threads(1)
            cv2.setNumThreads(1)
            os.nice(_NICENESS)
        robots = [Robot.load(path) for path in self._config.robots]
        seed = (self._config.seed, _TRAINING_STREAM, self._first_step, worker)
        generator = PairGenerator(robots, self._config.images, seed)
        rng = np.random.default_rng((*seed, 1))
        recent: deque[TrainingPair] = deque(maxlen=_MEMORY)
        while True:
            recent.append(generator())
            yield to_tensors(recent[-1])
            for _ in range(self._config.reuse - 1):
                yield to_tensors(
                    flipped(recent[rng.integers(len(recent))], bool(rng.integers(2)), bool(rng.integers(2)))
                )


def flipped(pair: TrainingPair, horizontally: bool, vertically: bool) -> TrainingPair:
    """The pair mirrored; a mirrored instrument is still one."""
    rows, columns = slice(None, None, -1 if vertically else 1), slice(None, None, -1 if horizontally else 1)
    return TrainingPair(
        pair.observed[rows, columns],
        pair.observed_classes[rows, columns],
        pair.hybrid[rows, columns],
        pair.hybrid_classes[rows, columns],
    )


def to_tensors(pair: TrainingPair) -> tuple[Int[Tensor, "2 3 h w"], Int[Tensor, "2 h w"]]:
    """Observed and hybrid image of a pair, and their classes, as uint8 tensors."""
    images = np.stack([pair.observed, pair.hybrid]).transpose(0, 3, 1, 2)
    classes = np.stack([pair.observed_classes, pair.hybrid_classes])
    return torch.from_numpy(np.ascontiguousarray(images)), torch.from_numpy(np.ascontiguousarray(classes))


def training_batches(config: TrainingConfig, first_step: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Endless batches of images [batch, 2, 3, h, w] and classes [batch, 2, h, w], uint8.

    The stream depends on the seed, the number of workers and the step that it starts at.
    """
    loader = DataLoader(
        _PairDataset(config, first_step),
        batch_size=config.batch_pairs,
        num_workers=config.workers,
        prefetch_factor=2 if config.workers else None,
        # A forked child hangs in OpenMP as soon as the parent has used threads.
        multiprocessing_context="spawn" if config.workers else None,
    )
    return iter(loader)


def validation_set(config: TrainingConfig) -> tuple[Float[Tensor, "pairs 2 3 h w"], Int[Tensor, "pairs 2 h w"]]:
    """The same pairs every time, from random numbers that training never sees."""
    robots = [Robot.load(path) for path in config.robots]
    generator = PairGenerator(robots, config.images, (config.seed, VALIDATION_STREAM))
    images, classes = zip(*(to_tensors(generator()) for _ in range(config.validation_pairs)), strict=True)
    return torch.stack(images).float() / 255, torch.stack(classes)
