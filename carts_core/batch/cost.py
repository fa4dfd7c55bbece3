"""Throughput and cost of a batch: frames per second, remaining time, core hours, and times with other numbers of
workers."""

import heapq
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from ..wording import counted, duration_text
from .folder import KnownJob

MAX_WORKERS = 256
"""Maximum number of workers for which times are estimated."""
_HOUR = 3600.0


@dataclass(frozen=True)
class JobCost:
    """Cost of a finished job."""

    seconds: float
    """Duration [s]."""
    processor: float | None
    """Processor time [s]; None if it was not measured."""
    frames: int
    """Number of frames with a verdict."""


@dataclass(frozen=True)
class Cost:
    """Cost of the finished jobs of a batch, and estimates for all jobs.

    Estimates assume that the other jobs take as long as the finished jobs on average, and that the speed of a worker
    does not depend on the number of workers; the start of the workers is not included.
    """

    done: tuple[JobCost, ...]
    """Finished jobs whose duration is known, in the order of the manifest or of their completion."""
    waiting: int
    """Number of jobs that have neither finished nor failed, including those that run."""
    running: int = 0
    """Number of jobs that run."""

    @staticmethod
    def of(known: Iterable[KnownJob]) -> "Cost":
        """Cost of the jobs of a batch folder."""
        known = list(known)
        done = [
            JobCost(
                sum(step.seconds for step in steps),
                None if any(step.processor is None for step in steps) else sum(step.processor or 0.0 for step in steps),
                entry.results.frames if entry.results else 0,
            )
            for entry in known
            if entry.status == "done" and (steps := entry.state.steps.values())
        ]
        finished = sum(entry.status in ("done", "failed") for entry in known)
        return Cost(tuple(done), len(known) - finished, sum(entry.status == "running" for entry in known))

    @cached_property
    def frames(self) -> int:
        """Number of frames of the finished jobs."""
        return sum(job.frames for job in self.done)

    @property
    def core_hours(self) -> float | None:
        """Processor time of the finished jobs [h]; None if it was not measured for all of them."""
        times = [job.processor for job in self.done if job.processor is not None]
        return sum(times) / _HOUR if self.done and len(times) == len(self.done) else None

    @property
    def all_core_hours(self) -> float | None:
        """Estimated processor time of all jobs [h]."""
        hours = self.core_hours
        return None if hours is None else hours * (1.0 + self.waiting / len(self.done))

    @cached_property
    def mean_seconds(self) -> float | None:
        """Mean duration of a finished job [s]."""
        return sum(job.seconds for job in self.done) / len(self.done) if self.done else None

    def frame_rate(self, workers: int) -> float | None:
        """Frames per second of several workers while all of them work; None if it is unknown."""
        mean = self.mean_seconds
        return workers * self.frames / (mean * len(self.done)) if self.frames and mean else None

    def time_left(self, workers: int) -> float | None:
        """Estimated time until all jobs have finished [s], if half of each job that runs is done; None if unknown."""
        mean = self.mean_seconds
        if mean is None:
            return None
        rounds = max(1.0, self.waiting / workers) if self.waiting else 0.0
        return mean * (rounds - 0.5 if self.running and rounds else rounds)

    def total_time(self, workers: int) -> float | None:
        """Estimated time of all jobs with several workers [s], each of which takes the next job in the order of `done`;
        None if it is unknown."""
        mean = self.mean_seconds
        if mean is None:
            return None
        free = [0.0] * workers
        for seconds in (*(job.seconds for job in self.done), *[mean] * self.waiting):
            heapq.heapreplace(free, free[0] + seconds)
        return max(free)

    def worker_counts(self) -> list[int]:
        """Numbers of workers for which times are estimated: powers of two, up to the number of jobs."""
        jobs = min(len(self.done) + self.waiting, MAX_WORKERS)
        return [2**power for power in range(max(jobs, 1).bit_length())]

    def summary(self, workers: int) -> str:
        """Frames per second, remaining time and core hours in one line; empty if no job has finished.

        Args:
            workers: number of workers; 0 if none works.
        """
        parts = []
        if rate := self.frame_rate(max(workers, 1)):
            parts.append(f"{rate:.3g} frames/s" if workers else f"{rate:.3g} frames/s per worker")
        if workers and (left := self.time_left(workers)):
            parts.append(f"{duration_text(left)} left")
        if (hours := self.core_hours) is not None:
            parts.append(f"{hours:.3g} core hours")
        return ", ".join(parts)

    def estimates(self) -> list[dict[str, float | int | None]]:
        """For several numbers of workers, frames per second and times of all and of the remaining jobs [s]."""
        return [
            {
                "workers": workers,
                "frames_per_second": self.frame_rate(workers),
                "all_seconds": self.total_time(workers),
                "remaining_seconds": self.time_left(workers),
            }
            for workers in (self.worker_counts() if self.done else ())
        ]

    def forecast(self) -> str:
        """Times of all jobs with several numbers of workers in one line; empty if no job has finished."""
        times = [(row["workers"], row["all_seconds"]) for row in self.estimates()]
        return ", ".join(f"{counted(int(n or 0), 'worker')} {duration_text(float(time or 0))}" for n, time in times)
