"""Jobs on a cluster, through dask.distributed (extra `cluster`): its scheduler gives jobs of lost workers to others."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import dask.config
from distributed import Client, KilledWorker, LocalCluster, as_completed

from ..errors import SettingsError
from .engine import ATTEMPTS, Outcome, Work, lost
from .manifest import Job

LOCAL = "local"


class Cluster:
    """Workers of dask.distributed, which share a file system with this machine.

    Args:
        work: what is done with a job; a function that can be named.
        scheduler: address such as `tcp://10.0.0.1:8786`, or `local` for workers on this machine.
        workers: number of these.
        threads: of each.
    """

    def __init__(self, work: Work, scheduler: str, workers: int, threads: int) -> None:
        self._work, self._scheduler, self._workers, self._threads = work, scheduler, workers, threads

    def run(self, jobs: Sequence[Job]) -> Iterator[Outcome]:
        """Do all jobs; yields what came of each as it is known.

        Raises:
            SettingsError: nobody answers at the scheduler's address.
        """
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
                options = {"n_workers": self._workers, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
                address = held.enter_context(LocalCluster(**options)).scheduler_address  # pyright: ignore
            try:
                client = held.enter_context(Client(address, timeout="10s"))
            except (OSError, ValueError) as error:
                raise SettingsError(
                    f"--scheduler {self._scheduler}: nobody answers ({error}). Start one with `dask scheduler`, and "
                    "workers with `dask worker ADDRESS --nthreads 1`, or give `local`."
                ) from error
            futures = {client.submit(self._work, job, key=f"carts-{job.name}", pure=False): job for job in jobs}
            for future in as_completed(futures):
                job = futures[future]
                error = future.exception()
                if isinstance(error, KilledWorker):
                    yield lost(job)
                elif error is not None:
                    yield Outcome(job.name, "failed", f"{type(error).__name__}: {error}")
                else:
                    yield future.result()
