"""`carts batch`: results of the individual commands, for any distribution of jobs and after interruptions."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import pytest
from processes import command as of_process
from processes import descendants, eventually

from carts_core.batch.engines import Pool
from carts_core.batch.folder import JOB_FILE, known_jobs
from carts_core.batch.manifest import read_manifest
from carts_core.batch.report import write_batch_report
from carts_core.cli import main
from carts_core.cli.batch_job import BatchWork
from carts_core.files import output_path
from carts_core.networks import FeatureExtractor
from carts_core.settings.optimization import Engine

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=2, width=160, height=128, domains=("regular", "dark"))


def manifest(sequence: Path, count: int = 1, *, steps: str = '"optimize", "export"', further: str = "") -> Path:
    """So many jobs of one frame."""
    domains = '["regular", "dark"]'
    path = sequence.parent / "archive.toml"
    job = (
        f'[[jobs]]\nrecordings = ["{sequence.name}"]\ndomains = {domains}\nsteps = [{steps}]\n'
        '[jobs.options]\noptimize = ["--solver", "none", "--frames", "001"]\n'
    )
    if "export" in steps:
        job += 'export = ["--format", "coco", "--frames", "001"]\n'

    path.write_text('format = "carts-batch/1"\n' + count * job + further)
    return path


def results(batch: Path) -> dict[str, bytes]:
    """All files of the jobs except those with times and machines."""
    files = [path for path in sorted(batch.rglob("*")) if path.is_file()]
    names = {path.relative_to(batch).as_posix(): path for path in files}
    return {
        name: path.read_bytes()
        for name, path in names.items()
        if not name.startswith("report/") and not name.endswith((JOB_FILE, ".log"))
    }


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "carts_core.cli", "batch", *map(str, arguments)]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=7200)


def test_a_batch_writes_what_the_plain_commands_write_and_does_nothing_twice(
    sequence: Path, tmp_path: Path, said: Callable[[], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = tmp_path / "batch"
    command = ["batch", str(manifest(sequence)), "--output", str(batch), "--workers", "1"]
    main(command)
    told = said()
    assert "2 done" in told and re.search(r"2 jobs with 2 frames in \d+ s on 1 worker, [\d.e-]+ frames/s", told)
    assert "core hours" in told and "estimates for these jobs: 1 worker" in told
    # The page has to be allowed to read recordings that are elsewhere.
    assert f"cartsview{batch}--root{sequence.parent}" in "".join(told.split())
    for path in batch.glob("jobs/*/job.json"):
        steps = json.loads(path.read_text())["steps"]
        assert list(steps) == ["optimize", "findings", "export"] or list(steps) == ["optimize", "export", "findings"]
        assert all(0.0 <= step["processor"] and 0.0 <= step["seconds"] for step in steps.values())
    assert (batch / "inference.txt").read_text() in get_args(Engine)
    for domain in ("regular", "dark"):
        plain = tmp_path / "plain" / domain
        chosen = ["--domain", domain, "--frames", "001"]
        main(["optimize", str(sequence), "--output", str(plain / "optimize"), "--solver", "none", *chosen])
        table = plain / "optimize" / domain / "left" / "kinematics.csv"
        export = ["export", str(sequence), str(plain / "export"), "--format", "coco", "--kinematics", str(table)]
        main([*export, *chosen])
        (job,) = (batch / "jobs").glob(f"*{domain}")
        made = results(job)
        assert {name: made[name] for name in made if "/" in name} == results(plain)
        (verdict,) = json.loads(made["findings.json"])["frames"]
        assert verdict["verdict"] in ("good", "doubtful", "failed") and (job / verdict["picture"]).stat().st_size
    before = {path: path.stat().st_mtime_ns for path in batch.rglob("*.png") if "report" not in path.parts}
    said()
    monkeypatch.setattr(Pool, "run", lambda pool, jobs: map(pool._work, jobs))
    main(command)
    assert "2 done earlier" in said()
    assert before and {path: path.stat().st_mtime_ns for path in before} == before


def test_the_report_has_failures_first_verdicts_joints_and_base_frames(sequence: Path, tmp_path: Path) -> None:
    further = f'[[jobs]]\nrecordings = ["{sequence.name}"]\ndomains = ["foggy"]\nsteps = ["optimize"]\n'
    jobs, batch = read_manifest(manifest(sequence, steps='"optimize"', further=further)), output_path(tmp_path / "b")
    outcomes = {outcome.job: outcome for outcome in map(BatchWork(batch), jobs)}
    failed = [outcome for outcome in outcomes.values() if outcome.status == "failed"]
    assert len(failed) == 1 and "domain 'foggy' is not in" in failed[0].error
    page = write_batch_report(batch, "CaRTS batch <archive>", jobs).read_text()
    assert "<h1>CaRTS batch &lt;archive&gt;</h1>" in page
    assert re.findall(r"<td>(done|failed)</td>", page) == ["failed", "done", "done"]
    assert page.count("<figure>") == 3 and "<td>all jobs</td>" in page
    report = json.loads((batch / "report" / "report.json").path.read_text())
    assert [sum(counts.values()) for counts in report["verdicts"].values()] == [1, 1, 0]
    assert len(report["joints"]) == 7 and all(joint["frames"] == 2 for joint in report["joints"].values())
    assert [row["base_frame"] for row in report["base_frames"]] == ["PSM1 in left"] * 2
    assert all(row["translation_mm"] == 0.0 for row in report["base_frames"])


def test_a_base_frame_that_drifts_is_reported(sequence: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved.toml"
    T = [[1, 0, 0, 0.003], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    moved.write_text(sequence.read_text().replace("[arms.joints]", f"T_world_base = {T}\n[arms.joints]"))
    further = '[[jobs]]\nrecordings = ["moved.toml"]\nsteps = ["optimize"]\n[jobs.options]\n'
    further += 'optimize = ["--solver", "none", "--frames", "001"]\n'
    jobs, batch = read_manifest(manifest(sequence, steps='"optimize"', further=further)), output_path(tmp_path / "b")
    assert [BatchWork(batch)(job).status for job in jobs] == ["done"] * 3
    write_batch_report(batch, "drift", jobs)
    rows = json.loads((batch / "report" / "report.json").path.read_text())["base_frames"]
    assert [round(row["translation_mm"], 6) for row in rows] == [0.0, 0.0, 3.0]


def test_findings_of_a_job_whose_worker_died_before_them_are_made_when_it_goes_on(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (job, *_), batch = read_manifest(manifest(sequence, steps='"optimize"')), output_path(tmp_path / "b")
    assert BatchWork(batch)(job).status == "done"
    whole = results(batch.path)
    with monkeypatch.context() as patch:
        patch.setattr("carts_core.batch.results.write_findings", lambda *_: pytest.fail("its worker dies"))
        with pytest.raises(pytest.fail.Exception):
            BatchWork(batch, again=True)(job)
    # What they were before is not taken for what they are now.
    assert "findings.json" not in {Path(name).name for name in results(batch.path)}
    assert BatchWork(batch)(job).status == "known" and results(batch.path) == whole


def test_a_job_is_done_again_when_its_recording_or_its_options_change(sequence: Path, tmp_path: Path) -> None:
    batch = output_path(tmp_path / "b")

    def statuses() -> list[str]:
        return [BatchWork(batch)(job).status for job in read_manifest(path)]

    path = manifest(sequence, steps='"optimize"')
    assert statuses() == ["done", "done"] and statuses() == ["known", "known"]
    sequence.write_text(sequence.read_text() + "# another\n")
    assert statuses() == ["done", "done"] and statuses() == ["known", "known"]
    path.write_text(path.read_text().replace('"--frames", "001"]', '"--frames", "002"]'))
    assert statuses() == ["done", "done"]
    (batch / "jobs" / read_manifest(path)[0].name / JOB_FILE).path.write_text("{")
    assert statuses() == ["done", "known"]


@pytest.mark.parametrize("engine", get_args(Engine))
def test_every_step_that_runs_the_network_knows_with_what(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: Engine
) -> None:
    class Loaded(BaseException):
        """The weights were asked for, and nothing more is of interest."""

    asked = []

    def load(*files: Path, **options: object) -> None:
        asked.append(options)
        raise Loaded

    monkeypatch.setattr(FeatureExtractor, "load", load)
    (job, *_) = read_manifest(manifest(sequence, steps='"optimize"'))
    with pytest.raises(Loaded):
        BatchWork(output_path(tmp_path / "b"), inference=engine)(job)
    assert [options["inference"] for options in asked] == [engine]


def test_a_wrong_manifest_is_reported_and_nothing_is_made(
    sequence: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    path = manifest(sequence, further='[[jobs]]\nrecordings = ["nowhere"]\nsteps = ["optimize"]\n')
    assert "matches no file" in refused("batch", path, "--output", tmp_path / "batch")
    assert not (tmp_path / "batch").exists()


def _killed_now_and_then(command: list[str | Path], every: float, seed: int) -> int:
    """Run a batch while one of its workers is killed so often [s], and at least one job is done between two of these;
    how many were killed."""
    process = subprocess.Popen(
        [sys.executable, "-m", "carts_core.cli", "batch", *map(str, command)],
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    ended, killed, chance = threading.Event(), [], random.Random(seed)
    jobs = Path(command[command.index("--output") + 1]) / "jobs"

    def kill() -> None:
        done = 0
        while not ended.wait(every):
            now = len(list(jobs.glob("*/findings.json")))
            workers = [child for child in sorted(descendants(process.pid)) if "spawn_main" in of_process(child)]
            if workers and now > done:
                chosen, done = chance.choice(workers), now
                killed.append(chosen)
                os.kill(chosen, signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    try:
        _, errors = process.communicate(timeout=7200)
    finally:
        ended.set()
        thread.join()
        process.kill()
    assert process.returncode == 0, errors.decode()
    return len(killed)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_200_jobs_come_to_the_same_bytes_on_the_pool_in_shards_and_on_a_cluster_with_workers_killed(
    sequence: Path, tmp_path: Path
) -> None:
    path, jobs = manifest(sequence, 100), 200
    assert run(path, "--output", tmp_path / "whole", "--workers", "2").returncode == 0
    whole = results(tmp_path / "whole")
    assert sum(name.endswith("kinematics.csv") for name in whole) == jobs
    for number in ("1/2", "2/2"):
        finished = run(path, "--output", tmp_path / "shards", "--workers", "2", "--shard", number)
        assert finished.returncode == 0, finished.stderr
    assert results(tmp_path / "shards") == whole
    for name, further in (("pool", []), ("cluster", ["--scheduler", "local"])):
        killed = _killed_now_and_then([path, "--output", tmp_path / name, "--workers", "2", *further], 10.0, 1)
        assert results(tmp_path / name) == whole and killed > 1
        batch = output_path(tmp_path / name)
        assert [entry.status for entry in known_jobs(batch, read_manifest(path))] == ["done"] * jobs
        print(f"{name}: {killed} workers killed")


@pytest.mark.slow
def test_a_stopped_batch_goes_on_and_comes_to_the_same_end(sequence: Path, tmp_path: Path) -> None:
    path = manifest(sequence, 2)
    assert run(path, "--output", tmp_path / "whole", "--workers", "1").returncode == 0
    command = [sys.executable, "-m", "carts_core.cli", "batch", str(path), "--output", str(tmp_path / "stopped")]
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    eventually(lambda: bool(list(tmp_path.glob("stopped/jobs/*/findings.json"))))
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)
    assert process.returncode in (0, 128 + signal.SIGTERM), errors
    assert process.returncode == 0 or "holds the finished jobs; rerun the command to resume" in errors
    finished = run(path, "--output", tmp_path / "stopped", "--workers", "1")
    assert finished.returncode == 0 and "done earlier" in finished.stdout
    assert results(tmp_path / "stopped") == results(tmp_path / "whole")
