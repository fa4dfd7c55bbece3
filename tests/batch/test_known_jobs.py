"""States and results of jobs: their cost, a report and a page of them, and files that are not as written."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from processes import eventually

from carts_core.batch import folder as batch_folder
from carts_core.batch.cost import Cost, JobCost
from carts_core.batch.folder import (
    FINDINGS_FILE,
    JOB_FILE,
    Findings,
    FrameFinding,
    JobState,
    StepState,
    known_jobs,
    read_state,
    write_jobs,
    write_state,
)
from carts_core.batch.manifest import Job
from carts_core.batch.report import write_batch_report
from carts_core.errors import OutputError
from carts_core.files import OutputPath, output_path, resolved_paths, write_text
from carts_viewer.start.batch_page import BatchPage

RNG = np.random.default_rng(5)


def steps(seconds: float = 4.0, processor: float | None = 3.0) -> dict[str, StepState]:
    return {"sequence": StepState("0" * 64, seconds, processor)}


def findings(frames: int) -> Findings:
    values = RNG.normal(size=(2, frames)).round(6).tolist()
    found = [FrameFinding("left", f"{frame:03d}", "good", "The fit is good.", 0.25) for frame in range(frames)]
    return Findings(
        "/r", found, {"psm1.yaw": values[0]}, {"psm1.yaw": values[1][1:]}, {"psm1 in left": np.eye(4).tolist()}
    )


def archive(folder: Path, frames: list[int], **unfinished: JobState) -> tuple[OutputPath, list[Job], list[Findings]]:
    """Batch with a finished job for each number of frames, and further jobs with these states."""
    names = [f"case{number:03d}" for number in range(len(frames))]
    jobs = [Job(name, folder / f"{name}.toml", "all", "", ("sequence",)) for name in [*names, *unfinished]]
    batch, written = output_path(folder), [findings(count) for count in frames]
    write_jobs(batch, jobs)
    for name, found in zip(names, written, strict=True):
        write_state(batch / "jobs" / name, JobState("done", steps()))
        write_text(batch / "jobs" / name / FINDINGS_FILE, msgspec.json.encode(found).decode())
    for name, state in unfinished.items():
        write_state(batch / "jobs" / name, state)
    return batch, jobs, written


def test_cost_counts_finished_jobs_and_estimates_the_others(tmp_path: Path) -> None:
    states = {"f": JobState("failed", steps()), "s": JobState("stopped"), "w": JobState("waiting")}
    batch, jobs, _ = archive(tmp_path, [10, 30], **states)
    cost = Cost.of(known_jobs(batch, jobs))
    assert (cost.frames, len(cost.done), cost.waiting, cost.running) == (40, 2, 2, 0)
    assert cost.frame_rate(1) == 5.0 and cost.frame_rate(3) == 15.0
    assert cost.core_hours == pytest.approx(6 / 3600) and cost.all_core_hours == pytest.approx(12 / 3600)
    assert cost.time_left(1) == 8.0 and cost.time_left(2) == 4.0
    assert [row["all_seconds"] for row in cost.estimates()] == [16.0, 8.0, 4.0]
    assert cost.summary(0) == "5 frames/s per worker, 0.00167 core hours"
    assert cost.forecast() == "1 worker 16 s, 2 workers 8 s, 4 workers 4 s"


def test_workers_take_the_next_job_and_the_longest_job_limits_them() -> None:
    cost = Cost(tuple(JobCost(seconds, None, 1) for seconds in (1.0, 5.0, 2.0, 2.0)), 0)
    assert [cost.total_time(workers) for workers in (1, 2, 3, 4)] == [10.0, 5.0, 5.0, 5.0]
    assert cost.core_hours is None and "core hours" not in cost.summary(2)


def test_while_jobs_run_half_of_each_is_assumed_to_be_done() -> None:
    cost = Cost((JobCost(10.0, 8.0, 100),), waiting=6, running=2)
    assert cost.time_left(2) == 25.0 and cost.summary(2) == "20 frames/s, 25 s left, 0.00222 core hours"
    assert Cost((JobCost(10.0, 8.0, 100),), waiting=1, running=1).time_left(8) == 5.0
    assert Cost((), waiting=3, running=2).summary(2) == ""


def test_states_of_earlier_versions_have_no_processor_time(tmp_path: Path) -> None:
    batch, jobs, _ = archive(tmp_path, [5])
    state = json.loads((tmp_path / "jobs" / "case000" / JOB_FILE).read_text())
    del state["steps"]["sequence"]["processor"]
    write_text(batch / "jobs" / "case000" / JOB_FILE, json.dumps(state))
    (known,) = known_jobs(batch, jobs)
    assert known.status == "done" and Cost.of([known]).core_hours is None and Cost.of([known]).frame_rate(2) == 2.5
    assert "– core hours" in write_batch_report(batch, "old", jobs).read_text()


def test_a_report_has_the_statistics_of_all_values_and_the_cost(tmp_path: Path) -> None:
    batch, jobs, written = archive(tmp_path, [3, 1, 0, 7], x=JobState("failed", error="Line\nNo space <left>."))
    page = write_batch_report(batch, "all", jobs).read_text()
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    values = np.concatenate([found.corrections["psm1.yaw"] for found in written])
    deviations = np.concatenate([found.deviations["psm1.yaw"] for found in written])
    assert report["joints"]["psm1.yaw"] == {
        "frames": 11,
        "mean": pytest.approx(values.mean()),
        "deviation": pytest.approx(values.std()),
        "median_size": np.median(np.abs(values)),
        "largest_size": np.abs(values).max(),
        "median_reported": np.median(deviations),
    }
    assert report["jobs"]["x"] == {"status": "failed", "error": "Line\nNo space <left>."}
    assert report["verdicts"]["case003"] == {"good": 7, "doubtful": 0, "failed": 0}
    assert report["cost"]["frames"] == 11 and [row["workers"] for row in report["cost"]["workers"]] == [1, 2, 4]
    assert "<td>No space &lt;left&gt;.</td>" in page and page.count("<svg") == 1 and "psm1.yaw</text>" in page


def test_damaged_results_are_reported_and_the_other_jobs_are_read(tmp_path: Path) -> None:
    batch, jobs, _ = archive(tmp_path, [2, 2, 2])
    (tmp_path / "jobs" / "case000" / FINDINGS_FILE).write_text('{"recording": 3}')
    (tmp_path / "jobs" / "case001" / JOB_FILE).write_text("{")
    damaged, failed, whole = known_jobs(batch, jobs)
    assert damaged.results is None and "Run the batch again to recreate it" in damaged.error
    assert failed.status == "failed" and "job.json cannot be read" in failed.error
    assert whole.results is not None and whole.results.frames == 2


def test_jobs_of_another_computer_are_lost_without_a_recent_heartbeat(tmp_path: Path) -> None:
    silent, beating, here = (
        JobState("running", worker=f"{host}:1", heartbeat=beat)
        for host, beat in (("other", 1.0), ("other", time.time()), (socket.gethostname(), time.time()))
    )
    batch, jobs, _ = archive(tmp_path, [], silent=silent, beating=beating, here=here)
    assert [entry.status for entry in known_jobs(batch, jobs)] == ["lost", "running", "lost"]


def test_the_heartbeat_goes_on_after_a_failed_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = list[OutputPath]()

    def full(folder: OutputPath, state: JobState) -> None:
        if threading.current_thread().name == "heartbeat" and not failed:
            failed.append(folder)
            raise OutputError(f"{folder} cannot be written (No space left on device).")
        write_state(folder, state)

    monkeypatch.setattr(batch_folder, "write_state", full)
    monkeypatch.setattr(batch_folder, "HEARTBEAT_SECONDS", 0.01)
    folder = output_path(tmp_path / "job")
    with batch_folder.running(folder) as job:
        assert job is not None
        eventually(lambda: bool(failed))
        before = read_state(folder).heartbeat
        eventually(lambda: read_state(folder).heartbeat > before)


def test_links_in_the_folder_of_jobs_are_not_followed(tmp_path: Path) -> None:
    batch, jobs, _ = archive(tmp_path, [2, 2])
    (tmp_path / "jobs" / "case000").rename(tmp_path / "elsewhere")
    (tmp_path / "jobs" / "case000").symlink_to(tmp_path / "elsewhere")
    linked = tmp_path / "jobs" / "case001" / FINDINGS_FILE
    linked.rename(tmp_path / "other.json")
    linked.symlink_to(tmp_path / "other.json")
    first, second = known_jobs(batch, jobs)
    assert first.status == "waiting" and first.results is None
    assert second.status == "done" and second.results is None and second.damage == ""


@pytest.mark.parametrize("given", ["a/x", "link/x", "link/../x", "./a//b/../x", "a/loose", "/", "."])
def test_paths_are_resolved_as_by_pathlib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "link").symlink_to("a/b")
    (tmp_path / "a" / "loose").symlink_to("../link/nowhere")
    monkeypatch.chdir(tmp_path)
    absolute = os.path.join(tmp_path, given)
    assert resolved_paths([given, Path(given), absolute]) == [str(Path(given).resolve())] * 2 + [
        str(Path(absolute).resolve())
    ]


class Shown:
    """Host of a page that keeps the sent documents."""

    def __init__(self) -> None:
        self.document = self.page = self.media = self
        self.sent: list[str] = []
        self.posted: list[Callable[[], None]] = []

    def show(self, content: str) -> None:
        """Keep a document."""
        self.sent.append(content)

    def post(self, function: Callable[[], None]) -> None:
        """Keep an update."""
        self.posted.append(function)

    def listed(self) -> list[str]:
        """Names of the jobs in the last document."""
        return [part.partition("<br>")[0] for part in self.sent[-1].split("<tr>\n        <td>")[1:]]


def test_the_page_lists_a_hundred_jobs_at_a_time_and_finds_the_others(tmp_path: Path) -> None:
    batch, jobs, _ = archive(tmp_path, 230 * [1])
    host = Shown()
    page = BatchPage(cast(Any, host), batch.path)
    page.show()
    names = [job.name for job in jobs]
    assert host.listed() == names[:100] and "1 to 100 of 230" in host.sent[-1]
    assert "0.25 frames/s per worker" in host.sent[-1] and "256 workers" not in host.sent[-1]
    for _ in range(3):
        page.choose("next", "")
    assert host.listed() == names[200:] and "201 to 230 of 230" in host.sent[-1]
    page.choose("previous", "")
    assert host.listed() == names[100:200]
    page.choose("find", "CASE22")
    assert host.listed() == names[220:230]
    page.choose("find", "<b>" * 100)
    assert host.listed() == [] and "No job name contains this text." in host.sent[-1] and "<b><b>" not in host.sent[-1]
    page.close()


def test_an_unchanged_page_is_not_sent_again(tmp_path: Path) -> None:
    batch, jobs, _ = archive(tmp_path, [1, 1])
    host = Shown()
    page = BatchPage(cast(Any, host), batch.path)
    page.show()
    page.choose("refresh", "")
    assert len(host.sent) == 1
    write_state(batch / "jobs" / jobs[0].name, JobState("failed", error="No space left."))
    page.choose("refresh", "")
    assert len(host.sent) == 2 and "No space left." in host.sent[-1]
    page.close()


TORCHLESS = """
import sys
from pathlib import Path
from carts_core.cli import main
from carts_viewer.start.site import Site
manifest, batch = map(Path, sys.argv[1:])
main(["batch", str(manifest), "--output", str(batch), "--report-only"])
with Site([batch], port=0, batch=batch) as site:
    site.wait()
    assert "1 done" in site.document.content, site.document.content
assert "torch" not in sys.modules and "scipy.optimize" not in sys.modules
"""


def test_report_and_page_need_no_torch(tmp_path: Path) -> None:
    archive(tmp_path / "b", [2])
    (tmp_path / "case000.toml").write_text("")
    text = 'format = "carts-batch/1"\n[[jobs]]\nrecordings = ["case000.toml"]\nsteps = ["sequence"]\n'
    (tmp_path / "archive.toml").write_text(text)
    command = [sys.executable, "-c", TORCHLESS, str(tmp_path / "archive.toml"), str(tmp_path / "b")]
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    subprocess.run(command, check=True, timeout=300, env=environment)
    assert (tmp_path / "b" / "report" / "report.html").is_file()
