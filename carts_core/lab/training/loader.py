"""Training batches, made in worker processes while the network trains."""

import os
from collections import deque
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from ...settings import TrainingConfig
from .task import Batch
from .tasks import task_of

VALIDATION_STREAM = 1
_TRAINING_STREAM = 0
_NICENESS = 1
_MEMORY = 300


class _Samples(IterableDataset):
    """An endless stream of samples; each worker and each start of training has its own."""

    def __init__(self, config: TrainingConfig, first_step: int) -> None:
        self._config = config
        self._first_step = first_step

    def __iter__(self) -> Iterator[Batch]:
        info = get_worker_info()
        worker = 0
        if info is not None:
            worker = info.id
            # One thread per process: the processes themselves fill the cores. Training itself goes first.
            torch.set_num_threads(1)
            cv2.setNumThreads(1)
            os.nice(_NICENESS)
        task = task_of(self._config.network)
        seed = (self._config.seed, _TRAINING_STREAM, self._first_step, worker)
        generator = task.generator(self._config, seed)
        rng = np.random.default_rng((*seed, 1))
        recent: deque[Any] = deque(maxlen=_MEMORY)
        while True:
            recent.append(generator())
            yield task.tensors(recent[-1])
            for _ in range(self._config.reuse - 1):
                sample = recent[rng.integers(len(recent))]
                yield task.tensors(task.flipped(sample, bool(rng.integers(2)), bool(rng.integers(2))))


def training_batches(config: TrainingConfig, first_step: int) -> Iterator[Batch]:
    """Endless batches of the task's tensors.

    The stream depends on the seed, the number of workers and the step that it starts at.
    """
    loader = DataLoader(
        _Samples(config, first_step),
        batch_size=config.batch_size,
        num_workers=config.workers,
        prefetch_factor=2 if config.workers else None,
        # A forked child hangs in OpenMP as soon as the parent has used threads.
        multiprocessing_context="spawn" if config.workers else None,
    )
    return map(tuple, loader)


def validation_set(config: TrainingConfig) -> Batch:
    """The same samples every time, from random numbers that training never sees."""
    task = task_of(config.network)
    generator = task.generator(config, (config.seed, VALIDATION_STREAM))
    samples = [task.tensors(generator()) for _ in range(config.validation_samples)]
    return tuple(torch.stack(part) for part in zip(*samples, strict=True))
