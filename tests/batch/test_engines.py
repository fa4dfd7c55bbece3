"""Engines do every job once, whatever becomes of their workers."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import distributed
import pytest
from light_work import LightWork, process_and_threads

from carts_core.batch.engines import ATTEMPTS, Cluster, Pool, Work
from carts_core.batch.folder import known_jobs, running
from carts_core.batch.manifest import Job
from carts_core.files import output_path


def jobs(count: int) -> list[Job]:
    return [Job(f"job{number:02d}", Path("nowhere"), "all", "", ("optimize",), {}) for number in range(count)]


@pytest.mark.parametrize(
    ("engine", "given_up"),
    [
        pytest.param(lambda work: Pool(work, 2, 1), True, id="pool"),
        pytest.param(lambda work: Cluster(work, "local", 2, 1), False, id="dask", marks=pytest.mark.slow),
    ],
)
def test_jobs_of_a_killed_worker_are_done_by_another_one_until_they_are_given_up(
    tmp_path: Path, engine: Callable[[Work], Pool | Cluster], given_up: bool
) -> None:
    deaths = 99 if given_up else 1
    work = LightWork(tmp_path, dies=(("job01", 2), ("job02", deaths)), fails=("job03",))
    outcomes = list(engine(work).run(jobs(5)))
    assert sorted(outcome.job for outcome in outcomes) == [job.name for job in jobs(5)]
    found = {outcome.job: outcome for outcome in outcomes}
    failed = {"job02", "job03"} if given_up else {"job03"}
    assert {name for name, outcome in found.items() if outcome.status == "failed"} == failed
    begun, expected = (work.begun("job01"), work.begun("job02")), (3, min(deaths + 1, ATTEMPTS))
    # Dask repeats a job whose result was lost with its worker.
    assert begun == expected if given_up else begun >= expected and begun[1] >= expected[1]
    assert (f"died {ATTEMPTS} times" in found["job02"].error) is given_up


@pytest.mark.parametrize(
    "engine",
    [
        pytest.param(lambda work: Pool(work, 2, 1), id="pool"),
        pytest.param(lambda work: Cluster(work, "local", 2, 1), id="dask", marks=pytest.mark.slow),
    ],
)
def test_an_unexpected_error_of_a_job_is_reported_and_the_job_is_not_repeated(
    tmp_path: Path, engine: Callable[[Work], Pool | Cluster]
) -> None:
    work = LightWork(tmp_path, raises=("job01",))
    found = {outcome.job: outcome for outcome in engine(work).run(jobs(3))}
    assert [found[job.name].status for job in jobs(3)] == ["done", "failed", "done"]
    assert found["job01"].error == "OSError: No space left on device" and work.begun("job01") == 1


@pytest.mark.slow
def test_batches_with_jobs_of_the_same_names_share_a_scheduler(tmp_path: Path) -> None:
    works = [LightWork(tmp_path / name) for name in "ab"]
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster:
        for work in works:
            work.folder.mkdir()
        address: str = cluster.scheduler_address  # pyright: ignore[reportAttributeAccessIssue]
        first = Cluster(works[0], address, 1, 1).run(jobs(2))
        begun = next(first)
        second = list(Cluster(works[1], address, 1, 1).run(jobs(2)))
        assert {outcome.status for outcome in (begun, *second, *first)} == {"done"}
    assert [work.begun(job.name) for work in works for job in jobs(2)] == [1, 1, 1, 1]


def test_a_job_whose_process_was_killed_is_lost(tmp_path: Path) -> None:
    (job,), folder = jobs(1), output_path(tmp_path) / "jobs" / "job00"
    if (child := os.fork()) == 0:
        try:
            with running(folder):
                os.kill(os.getpid(), signal.SIGKILL)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert [entry.status for entry in known_jobs(output_path(tmp_path), [job])] == ["lost"]
    with running(folder):
        assert [entry.status for entry in known_jobs(output_path(tmp_path), [job])] == ["running"]


def test_workers_have_as_many_threads_as_asked_for_and_end_with_an_engine_that_is_ended_early(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    outcomes = Pool(process_and_threads, 2, 3).run(jobs(4))
    processes, threads = zip(*(next(outcomes).error.split() for _ in range(2)), strict=True)
    assert threads == ("3", "3") and os.environ["OMP_NUM_THREADS"] == "7" and "MKL_NUM_THREADS" not in os.environ
    outcomes.close()  # pyright: ignore[reportAttributeAccessIssue]
    for process in map(int, processes):
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
