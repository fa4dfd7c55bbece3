"""Engines that run the jobs of a batch: worker processes on this machine, or a dask.distributed cluster."""

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Literal
from uuid import uuid4

from ..errors import SettingsError
from ..stopping import Stopped, end_with_parent, stopped_by_signals
from .manifest import Job

ATTEMPTS = 5
"""Number of attempts at a job whose worker dies, after which the job is considered failed."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a job."""

    job: str
    status: Literal["done", "known", "busy", "failed", "stopped"]
    """`known`: done earlier; `busy`: run by another process."""
    error: str = ""
    seconds: float = 0.0
    """Duration [s]."""
    processor: float = 0.0
    """Processor time [s]."""
    frames: int = 0
    """Number of frames with a verdict."""


Work = Callable[[Job], Outcome]
"""Function that runs a job; failures are described in the outcome."""


def worker_died(job: Job) -> Outcome:
    """Outcome of a job whose worker died in every attempt."""
    return Outcome(
        job.name, "failed", f"its worker process died {ATTEMPTS} times, perhaps due to a lack of memory; see its log"
    )


_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
_PATIENCE = 10.0
"""Time allowed for a process to end [s]."""


@dataclass
class _Worker:
    process: BaseProcess
    connection: Connection
    job: Job | None = None
    """Current job of the worker."""


class Pool:
    """Pool of worker processes with `threads` threads each; `work` must be picklable.

    Attributes:
        workers: number of parallel jobs.
    """

    def __init__(self, work: Work, workers: int, threads: int) -> None:
        self._work, self.workers, self._threads = work, workers, threads
        self._context = multiprocessing.get_context("spawn")

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Run all jobs; yields outcomes in order of completion. Closing the iterator ends the processes."""
        waiting, attempts = deque(jobs), dict.fromkeys((job.name for job in jobs), 0)
        workers: list[_Worker] = []
        try:
            while waiting or any(worker.job for worker in workers):
                missing = min(self.workers, len(waiting) + sum(worker.job is not None for worker in workers))
                workers += [self._started() for _ in range(missing - len(workers))]
                for worker in workers:
                    if worker.job is None and waiting:
                        _hand(worker, waiting, attempts)
                ready = wait([worker.connection for worker in workers if worker.job is not None], timeout=1.0)
                for worker in [worker for worker in workers if worker.connection in ready]:
                    job, worker.job = worker.job, None
                    assert job is not None
                    try:
                        yield worker.connection.recv()
                    except (EOFError, OSError):
                        workers.remove(worker)
                        _end(worker)
                        if attempts[job.name] < ATTEMPTS:
                            waiting.append(job)
                        else:
                            yield worker_died(job)
        finally:
            for worker in workers:
                worker.connection.close()
                if worker.job is not None:
                    worker.process.terminate()
            for worker in workers:
                _end(worker)

    def _started(self) -> _Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=_serve, args=(theirs, self._work, os.getpid()), name="carts-batch", daemon=True
        )
        with _threads_of_children(self._threads):
            process.start()
        theirs.close()
        return _Worker(process, ours)


def _hand(worker: _Worker, waiting: deque[Job], attempts: dict[str, int]) -> None:
    """Send a job to a worker; a dead worker is detected when its answer is received."""
    worker.job = waiting.popleft()
    attempts[worker.job.name] += 1
    with suppress(OSError):
        worker.connection.send(worker.job)


def _end(worker: _Worker) -> None:
    worker.connection.close()
    worker.process.join(_PATIENCE)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
    worker.process.close()


@contextmanager
def _threads_of_children(threads: int) -> Iterator[None]:
    """Limit the threads of child processes by environment variables, which libraries read on import."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(threads)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(connection: Connection, work: Callable[[Job], Outcome], parent: int) -> None:
    """Run jobs until the connection is closed or the parent process ends."""
    with stopped_by_signals(), suppress(Stopped):
        end_with_parent(parent)
        while True:
            try:
                job = connection.recv()
            except (EOFError, OSError):
                return
            try:
                outcome = work(job)
            except Exception as error:  # Such as a full disk, on which the state of the job could not be written.
                outcome = _raised(job, error)
            with suppress(OSError):
                connection.send(outcome)


def _raised(job: Job, error: BaseException) -> Outcome:
    return Outcome(job.name, "failed", f"{type(error).__name__}: {error}")


LOCAL = "local"


class Cluster:
    """Cluster of dask.distributed workers, which share a file system with this machine.

    Args:
        work: function that runs a job; must be picklable.
        scheduler: address such as `tcp://10.0.0.1:8786`, or `local` for workers on this machine.
        workers: number of local workers.
        threads: number of threads per worker.

    Attributes:
        workers: number of parallel jobs; that of a running scheduler is known once `run` has begun.
    """

    def __init__(self, work: Work, scheduler: str, workers: int, threads: int) -> None:
        self._work, self._scheduler, self.workers, self._threads = work, scheduler, workers, threads

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Run all jobs; yields outcomes in order of completion. `SettingsError` if the scheduler does not respond."""
        # These optional dependencies are not needed by worker processes on this machine.
        import dask.config  # noqa: PLC0415
        from distributed import Client, KilledWorker, LocalCluster, as_completed  # noqa: PLC0415

        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), self._threads)
        dask.config.set(
            {
                "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
                "distributed.nanny.pre-spawn-environ": threads,
            }
        )
        with ExitStack() as held:
            address = self._scheduler
            if address == LOCAL:
                options = {"n_workers": self.workers, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
                address = held.enter_context(LocalCluster(**options)).scheduler_address  # pyright: ignore
            try:
                client = held.enter_context(Client(address, timeout="10s"))
            except (OSError, ValueError) as error:
                raise SettingsError(
                    f"--scheduler {self._scheduler}: the scheduler does not respond ({error}). Start it with `dask "
                    "scheduler`, and workers with `dask worker ADDRESS --nthreads 1`, or use `local`."
                ) from error
            self.workers = sum(client.nthreads().values()) or self.workers  # pyright: ignore
            # Batches of the same scheduler may have jobs of equal names.
            batch = uuid4().hex
            futures = {client.submit(self._work, job, key=f"carts-{batch}-{job.name}", pure=False): job for job in jobs}
            for future in as_completed(futures):
                job = futures[future]
                error = future.exception()
                if isinstance(error, KilledWorker):
                    yield worker_died(job)
                elif error is not None:
                    yield _raised(job, error)
                else:
                    yield future.result()
