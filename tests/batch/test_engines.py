"""Engines do every job once, whatever becomes of their workers."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from light_work import LightWork

from carts_core.batch.engines import ATTEMPTS, Cluster, Outcome, Pool, Work
from carts_core.batch.folder import present_status
from carts_core.batch.manifest import Job
from carts_core.files import OutputPath, output_path

Engine = Callable[[Work], Pool | Cluster]


def jobs(count: int) -> list[Job]:
    return [Job(f"job{number:02d}", Path("nowhere"), "all", "", ("optimize",), {}) for number in range(count)]


@pytest.fixture
def folder(tmp_path: Path) -> OutputPath:
    return output_path(tmp_path / "jobs")


def results(folder: OutputPath, work: LightWork, engine: Engine, count: int = 6) -> dict[str, Outcome]:
    """What came of so many jobs, each reported once."""
    outcomes = list(engine(work).run(jobs(count)))
    assert sorted(outcome.job for outcome in outcomes) == [job.name for job in jobs(count)]
    return {outcome.job: outcome for outcome in outcomes}


@pytest.mark.parametrize(
    "engine",
    [
        pytest.param(lambda work: Pool(work, 2, 1), id="pool"),
        pytest.param(lambda work: Cluster(work, "local", 2, 1), id="dask"),
    ],
)
def test_jobs_of_a_killed_worker_are_done_by_another_one(folder: OutputPath, engine: Engine) -> None:
    work = LightWork(folder, dies=(("job01", 1), ("job04", 2)), fails=("job03",))
    found = results(folder, work, engine)
    assert {name for name, outcome in found.items() if outcome.status == "failed"} == {"job03"}
    for job in jobs(6):
        status, _ = present_status(folder / job.name)
        assert status == ("failed" if job.name == "job03" else "done")
        begun = (folder / job.name / "begun.txt").path.read_text().split()
        if job.name in ("job01", "job04"):
            assert len(begun) == {"job01": 2, "job04": 3}[job.name]
        if job.name != "job03":
            assert (folder / job.name / "result.txt").path.read_text() == job.name


def test_a_job_that_kills_every_worker_is_given_up_and_the_others_are_done(folder: OutputPath) -> None:
    found = results(folder, LightWork(folder, dies=(("job00", 99),)), lambda work: Pool(work, 1, 1), count=3)
    assert found["job00"].status == "failed" and f"died {ATTEMPTS} times" in found["job00"].error
    assert found["job01"].status == found["job02"].status == "done"
    assert present_status(folder / "job00")[0] == "lost"


def test_a_worker_has_as_many_threads_as_asked_for_and_its_parent_keeps_its_own(
    folder: OutputPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert [outcome.error for outcome in Pool(threads_told, 1, 3).run(jobs(1))] == ["3"]
    assert os.environ["OMP_NUM_THREADS"] == "7" and "MKL_NUM_THREADS" not in os.environ


def threads_told(job: Job) -> Outcome:
    """How many threads the worker has."""
    return Outcome(job.name, "done", os.environ["OMP_NUM_THREADS"])


def test_an_engine_that_is_ended_early_ends_its_workers(folder: OutputPath) -> None:
    outcomes = Pool(own_process, 2, 1).run(jobs(4))
    processes = {int(next(outcomes).error), int(next(outcomes).error)}
    outcomes.close()  # pyright: ignore[reportAttributeAccessIssue]
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def own_process(job: Job) -> Outcome:
    """The number of the worker's process."""
    return Outcome(job.name, "done", str(os.getpid()))
