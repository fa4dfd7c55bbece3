"""The viewer is killed or asked to end at any moment.

What the page has called saved is there, every job resumes or has failed, and nothing is half-written.
"""

import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from victims import Client, Widgets, begin, check_whole, queue_jobs, serve_until_signal
from waiting import eventually

from carts_core.project import Project, SequenceIdentity
from carts_core.recording import Sequence
from carts_viewer.jobs.companions import Decisions
from carts_viewer.jobs.job_list import JobList
from tools.raw_tab import RawTab

FRAMES = 24
WIDTH, HEIGHT = 96, 72
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)


@dataclass
class Tally:
    """What all lives of the viewer together saw."""

    acknowledged: int = 0
    runs: int = 0
    strokes: int = 0
    acknowledged_exports: int = 0
    whole_exports: int = 0
    interrupted_exports: int = 0


class Lives:
    """One project through many lives of the viewer, each of which ends with a signal."""

    def __init__(self, sequence_path: Path, weights: Path) -> None:
        self._path, self._weights = sequence_path, weights
        self._sequence = Sequence.open(sequence_path)
        self._project_path = sequence_path.with_suffix(".carts")
        self._exports = sequence_path.with_name(f"{sequence_path.stem}_exports")
        self._beside = {path.name for path in sequence_path.parent.iterdir()} | {self._exports.name}
        self._names: list[str] = []
        """Of all steps."""
        self._known: set[tuple[str, int]] = set()
        """Exports, finished or not, that were there before this life."""
        self._unique = iter(range(1, 10**9))
        self._pixels = iter([(row, column) for row in range(HEIGHT) for column in range(WIDTH)])
        self.tally = Tally()

    def live(self, seed: int, least: int = 0) -> None:
        """Run edits in a new process until a signal ends it, after a minimum number of edits; check the files."""
        number, dice = SIGNALS[seed % len(SIGNALS)], random.Random(seed)
        victim, told = begin(serve_until_signal, self._path, self._weights)
        with RawTab(told.recv(), keep=1) as tab:
            ids: Widgets = told.recv()
            assert told.recv() == "ready" and victim.pid is not None
            client = Client(tab, ids, FRAMES, dice, self._unique, self._pixels)
            pid, delay = victim.pid, 0.05 + 2.0 * dice.random()
            before = self._unfinished()

            def end() -> None:
                patience = time.monotonic() + 60
                while len(client.seen) < least and time.monotonic() < patience:
                    time.sleep(0.05)
                if seed % 4 == 3:
                    # This signal comes while an export is being written.
                    patience = time.monotonic() + 20
                    while self._unfinished() <= before and time.monotonic() < patience:
                        time.sleep(0.001)
                    time.sleep(0.02 * delay)
                else:
                    time.sleep(delay)
                os.kill(pid, number)

            killer = threading.Thread(target=end)
            killer.start()
            client.work()
            killer.join()
        victim.join(60)
        assert victim.exitcode == (-9 if number == signal.SIGKILL else 0), victim.exitcode
        self._check_project(client)
        self._check_exports()
        self.tally.acknowledged += len(client.seen)
        self.tally.runs += client.runs
        self.tally.strokes += client.strokes
        self.tally.acknowledged_exports += len(client.exported)

    def _unfinished(self) -> set[str]:
        """Names of exports that are being written or were interrupted."""
        present = self._exports.iterdir() if self._exports.exists() else ()
        return {path.name for path in present if path.name.startswith(".")}

    def _check_project(self, client: Client) -> None:
        """Open the project as the next server would, and check what this life's client has heard."""
        with Project.open(self._sequence, self._project_path) as project:
            assert project.writable
            steps = [step.name for step in project.state.steps]
            assert steps[: len(self._names)] == self._names, "steps of earlier lives have changed"
            assert project.state.position == len(steps)
            logged = {Path(export.path) for export in project.state.exports}
            assert client.exported <= logged and all(path.exists() for path in logged)
            for edit in client.seen:
                assert steps[edit.number - 1 : edit.number] == [edit.name], edit
                project.go_to(edit.number)
                assert edit.holds(project.state), edit
            project.go_to(len(steps))
        self._names = steps

    def _check_exports(self) -> None:
        """Whatever has a final name is whole, and nothing else has appeared beside the sequence."""
        for path in self._exports.iterdir() if self._exports.exists() else ():
            known = (path.name, path.stat().st_mtime_ns)
            if known in self._known:
                continue
            self._known.add(known)
            if path.name.startswith("."):
                self.tally.interrupted_exports += 1
            else:
                check_whole(path, FRAMES)
                self.tally.whole_exports += 1
        project_files = {self._project_path.name + end for end in ("", "-wal", "-shm")}
        project_files.add(f"{self._project_path.stem}_jobs.json")
        new = {path.name for path in self._path.parent.iterdir()} - self._beside
        assert new <= project_files, new


@pytest.fixture
def lives(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Lives:
    return Lives(tiny_sequence(frames=FRAMES, width=WIDTH, height=HEIGHT), untrained_weights)


def test_nothing_that_the_page_called_saved_is_lost_to_a_kill_or_a_signal(lives: Lives) -> None:
    for seed in range(len(SIGNALS)):
        lives.live(seed, least=4)
    tally = lives.tally
    assert tally.acknowledged >= 12 and tally.strokes > 0 and tally.whole_exports > 0, tally


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_is_lost_in_200_kills_and_signals(lives: Lives) -> None:
    for seed in range(200):
        lives.live(seed)
    tally = lives.tally
    print(tally)
    assert tally.acknowledged > 200 and tally.strokes > 50 and tally.runs > 20, tally
    assert tally.acknowledged_exports > 20 and tally.interrupted_exports > 20, tally


def test_a_note_under_the_cursor_is_saved_at_ctrl_c(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> None:
    path = tiny_sequence(frames=2)
    victim, told = begin(serve_until_signal, path, untrained_weights)
    with RawTab(told.recv(), keep=1) as tab:
        ids: Widgets = told.recv()
        assert told.recv() == "ready" and victim.pid is not None
        tab.set(ids.note, "half a th")
        eventually(lambda: "Not saved" in tab.widgets.get(ids.saved, {}).get("content", ""))
        os.kill(victim.pid, signal.SIGINT)
        victim.join(60)
    assert victim.exitcode == 0
    with Project.open(Sequence.open(path), read_only=True) as project:
        assert project.state.review(0).note == "half a th"


# ---- Jobs -----------------------------------------------------------------------------------------------------------

JOB_FRAMES = 4
OVER = ("done", "failed", "cancelled")


class JobLives:
    """One project and its queue through many lives of the viewer.

    Attributes:
        known: the newest state of every job that a page has shown.
        tally: jobs that `ran` at a kill and have failed, `waited` then and still do, and `resumed` in a later life.
    """

    def __init__(self, sequence: Path, weights: Path) -> None:
        self._path, self._weights = sequence, weights
        self._sequence = Sequence.open(sequence)
        self.known: dict[int, str] = {}
        self.tally = Counter[str]()

    def live(self, seed: int, *, kill: bool = True) -> None:
        """Queue and do jobs in a new process until it is killed, or until nothing is left; look what there is then."""
        victim, told = begin(queue_jobs, self._path, self._weights, seed, kill)
        told.recv()
        end = time.monotonic() + (random.Random(seed).uniform(0.1, 5.0) if kill else 300.0)
        waited = {number for number, state in self.known.items() if state == "waiting"}
        while True:
            # A kill may come in the middle of a message.
            try:
                said = told.recv() if told.poll(max(0.0, end - time.monotonic())) else None
            except (EOFError, OSError):
                break
            if said is None:
                break
            for number, _, state in said:
                resumed = number in waited and state == "running" and self.known.get(number) == "waiting"
                self.tally["resumed"] += resumed
                self.known[number] = state
        if kill:
            victim.kill()
        victim.join(60)
        assert victim.exitcode == (-9 if kill else 0)
        self._check()

    def _check(self) -> None:
        """List of jobs as read by the next viewer, the project, and the exports."""
        identity = SequenceIdentity.of(self._sequence)
        path = self._path.with_suffix(".carts")
        recording = {"frame_ids": identity.frame_ids, "recording": identity.kinematics_sha256}
        jobs = {job.number: job for job in JobList(path, kept=True, decisions=Decisions(), **recording).jobs}
        for number in sorted(self.known)[-40:]:
            assert number in jobs, f"job {number} is gone"
            now, shown = str(jobs[number].state), self.known[number]
            if shown in OVER:
                assert now == shown, f"job {number} was {shown}, and is {now}"
            elif shown == "running":
                # It may have ended since the page has last said so.
                assert now in OVER, f"job {number} ran, and is {now}"
                assert now != "failed" or jobs[number].text
                self.tally["ran"] += now == "failed"
            else:
                self.tally["waited"] += now == "waiting"
            self.known[number] = now
        with Project.open(self._sequence, path) as project:
            assert project.writable and project.state.position == len(project.state.steps)
            for export in project.state.exports:
                check_whole(Path(export.path), JOB_FRAMES)
            done = sum(str(job.state) == "done" and job.kind == "export" for job in jobs.values())
            assert done <= len(project.state.exports)


@pytest.fixture
def job_lives(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> JobLives:
    return JobLives(tiny_sequence(frames=JOB_FRAMES, width=WIDTH, height=HEIGHT), untrained_weights)


@pytest.mark.timeout(600)
def test_jobs_of_a_viewer_that_was_killed_resume_or_have_failed(job_lives: JobLives) -> None:
    job_lives.live(0)
    job_lives.live(99, kill=False)
    assert job_lives.known and set(job_lives.known.values()) <= set(OVER), job_lives.known


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_job_is_lost_in_50_kills(job_lives: JobLives) -> None:
    for seed in range(50):
        job_lives.live(seed)
    job_lives.live(99, kill=False)
    print(job_lives.tally)
    assert job_lives.tally["ran"] > 10 and job_lives.tally["resumed"] > 5, job_lives.tally
    assert set(job_lives.known.values()) <= set(OVER), job_lives.known
