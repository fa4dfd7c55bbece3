"""Training batches, generated in worker processes during training."""

import multiprocessing
import os
import signal
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from multiprocessing.synchronize import Event
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from ...settings import TrainingConfig
from ...stopping import end_with_parent
from .augmentation import randomized
from .cache import ImageCache, shards
from .tasks import Batch, SurfaceTask, task_of

VALIDATION_STREAM = 1
_TRAINING_STREAM = 0
_CHOICES = 1
_NICENESS = 1
_MEMORY = 300


class _Samples(Dataset):
    """Data set of training samples by number, so that a resumed run uses the same samples as an uninterrupted run.

    One in `reuse` samples is generated; the other samples are drawn from the newest `_MEMORY` generated samples and
    mirrored at random. Batches are distributed over the workers in turn, and each worker draws from its own samples.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self._config, self._lanes = config, max(config.workers, 1)
        self._generators: dict[int, Any] = {}
        self._made: dict[tuple[int, int], Any] = {}

    def __getitem__(self, number: int) -> Batch:
        config, task = self._config, task_of(self._config.network)
        batch, place = divmod(number, config.batch_size)
        lane, position = batch % self._lanes, batch // self._lanes * config.batch_size + place
        newest, repeats = divmod(position, config.reuse)
        if not repeats:
            return task.tensors(self._sample(lane, newest, newest))
        rng = np.random.default_rng((config.seed, _TRAINING_STREAM, lane, _CHOICES, position))
        chosen = newest - int(rng.integers(min(newest + 1, _MEMORY)))
        sample = self._sample(lane, chosen, newest)
        return task.tensors(task.flipped(sample, bool(rng.integers(2)), bool(rng.integers(2))))

    def _sample(self, lane: int, number: int, newest: int) -> Any:
        """Return a generated sample; samples from before an interruption are generated again."""
        key = lane, number
        if key not in self._made:
            if lane not in self._generators:
                stream = (self._config.seed, _TRAINING_STREAM, lane)
                self._generators[lane] = task_of(self._config.network).generator(self._config, stream)
            sample = self._generators[lane](number)
            if self._config.reuse == 1:
                return sample
            self._made[key] = sample
            self._made.pop((lane, newest - _MEMORY), None)
        return self._made[key]


class _CachedSamples(Dataset):
    """Data set of samples drawn from a cache by number, randomly changed and mirrored."""

    def __init__(self, config: TrainingConfig, shards: int) -> None:
        self._config, self._shards = config, shards
        self._cache: ImageCache | None = None

    def __getitem__(self, number: int) -> Batch:
        config = self._config
        if self._cache is None:
            assert config.cache is not None
            self._cache = ImageCache(config.cache, self._shards)
        rng = np.random.default_rng((config.seed, _TRAINING_STREAM, number))
        size = config.crop or (config.images.width, config.images.height)
        sample = randomized(rng, self._cache, int(rng.integers(len(self._cache))), size)
        task = SurfaceTask()
        return task.tensors(task.flipped(sample, bool(rng.integers(2)), bool(rng.integers(2))))


def share_processor() -> None:
    """Limit this process to one thread and a lower priority than the training process, since the processes occupy all
    cores."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.nice(_NICENESS)


def _start_worker(closing: Event, parent: int, worker: int) -> None:
    """Share the processor, and ignore signals to the process group, since the parent ends its workers after saving."""
    share_processor()
    end_with_parent(parent, signal.SIGKILL)

    def end_if_closing(*_: object) -> None:
        if closing.is_set():
            # An exception would wait for threads that wait for the parent.
            os._exit(0)

    signal.signal(signal.SIGTERM, end_if_closing)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)


@contextmanager
def training_batches(config: TrainingConfig, first_step: int) -> Iterator[Iterator[Batch]]:
    """Context manager with an endless stream of the task's batches; its exit ends the workers.

    A batch depends only on the seed, the number of workers and the number of the batch, not on the first step.
    """
    # A forked child would hang in OpenMP after the parent has used threads.
    spawning = multiprocessing.get_context("spawn")
    closing = spawning.Event()
    loader = DataLoader(
        _Samples(config) if config.cache is None else _CachedSamples(config, shards(config.cached)),
        batch_size=config.batch_size,
        sampler=count(first_step * config.batch_size),
        num_workers=config.workers,
        prefetch_factor=2 if config.workers else None,
        multiprocessing_context=spawning if config.workers else None,
        worker_init_fn=partial(_start_worker, closing, os.getpid()) if config.workers else None,
    )
    batches = _stream(loader)
    try:
        yield batches
    finally:
        closing.set()
        batches.close()


def _stream(loader: DataLoader) -> Generator[Batch]:
    """Batches of a loader; closing the generator drops the loader's iterator, which ends its workers."""
    for batch in loader:
        yield tuple(batch)


def validation_set(config: TrainingConfig) -> Batch:
    """Batch of validation samples, from a fixed random stream that training does not use."""
    task = task_of(config.network)
    generator = task.generator(config, (config.seed, VALIDATION_STREAM))
    samples = [task.tensors(generator(number)) for number in range(config.validation_samples)]
    return tuple(torch.stack(part) for part in zip(*samples, strict=True))
