"""The viewer is killed while it works on jobs: every job resumes or is said to have failed, and results are whole."""

import multiprocessing
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import job_victim
import pytest
import viewer_victim

from carts_core.project import Project, SequenceIdentity
from carts_core.recording import Sequence
from carts_viewer.jobs.companions import Decisions
from carts_viewer.jobs.job_list import JobList, JobState

FRAMES = 4
OVER = ("done", "failed", "cancelled")


@dataclass
class Tally:
    """What all lives of the viewer together saw."""

    kills: int = 0
    promised: int = 0
    """Jobs that a page has shown."""
    running: int = 0
    """Jobs that ran at the moment of a kill, and are said to have failed."""
    waited: int = 0
    """Jobs that waited then, and were still there."""
    resumed: int = 0
    """Jobs that waited at a kill, and ran in a later life."""
    whole: int = 0
    """Exports that are there, all of them whole."""
    states: dict[str, int] = field(default_factory=dict)
    """How all jobs ended."""


class JobLives:
    """One project and its queue through many lives of the viewer."""

    def __init__(self, sequence: Path, weights: Path) -> None:
        self._path, self._weights = sequence, weights
        self._sequence = Sequence.open(sequence)
        self._project = sequence.with_suffix(".carts")
        self._processes = multiprocessing.get_context("forkserver")
        self._processes.set_forkserver_preload(["carts_viewer.app"])
        self._known: dict[int, str] = {}
        """The newest state of every job that a page has shown."""
        self.tally = Tally()

    def live(self, seed: int, *, kill: bool = True) -> None:
        """Queue and do jobs in a new process until it is killed, or until nothing is left; look what there is then."""
        ours, theirs = self._processes.Pipe(duplex=False)
        victim = self._processes.Process(
            target=job_victim.queue_jobs, args=(self._path, self._weights, seed, kill, theirs), daemon=True
        )
        victim.start()
        theirs.close()
        assert ours.poll(120), "the viewer did not start"
        ours.recv()
        end = time.monotonic() + (random.Random(seed).uniform(0.1, 5.0) if kill else 300.0)
        waited = {number for number, state in self._known.items() if state == "waiting"}
        while True:
            # A kill may come in the middle of a message.
            try:
                said = ours.recv() if ours.poll(max(0.0, end - time.monotonic())) else None
            except (EOFError, OSError):
                break
            if said is None:
                break
            for number, _, state in said:
                self.tally.resumed += number in waited and state == "running" and self._known.get(number) == "waiting"
                self._known[number] = state
        if kill:
            victim.kill()
            self.tally.kills += 1
        victim.join(60)
        assert victim.exitcode == (-9 if kill else 0)
        self._check()

    def _check(self) -> None:
        """The list as the next viewer will read it, the project, and what was exported."""
        identity = SequenceIdentity.of(self._sequence)
        kept = JobList(
            self._project,
            kept=True,
            frame_ids=identity.frame_ids,
            recording=identity.kinematics_sha256,
            decisions=Decisions(),
        )
        jobs = {job.number: job for job in kept.jobs}
        newest = sorted(self._known)[-40:]
        for number in newest:
            assert number in jobs, f"job {number} is gone"
            now, shown = str(jobs[number].state), self._known[number]
            if shown in OVER:
                assert now == shown, f"job {number} was {shown}, and is {now}"
            elif shown == "running":
                # It may have ended since the page has last said so.
                assert now in OVER, f"job {number} ran, and is {now}"
                assert now != "failed" or jobs[number].text
                self.tally.running += now == "failed"
            else:
                self.tally.waited += now == "waiting"
            self._known[number] = now
        self.tally.promised = len(self._known)
        with Project.open(self._sequence, self._project) as project:
            assert project.writable and project.state.position == len(project.state.steps)
            for export in project.state.exports:
                viewer_victim.check_whole(Path(export.path), FRAMES)
            self.tally.whole = len(project.state.exports)
        # What is done is there.
        done = sum(job.state is JobState.DONE and job.kind == "export" for job in jobs.values())
        assert done <= self.tally.whole
        self.tally.states = {state: list(self._known.values()).count(state) for state in set(self._known.values())}


@pytest.fixture
def lives(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> JobLives:
    return JobLives(tiny_sequence(frames=FRAMES, width=96, height=72), untrained_weights)


@pytest.mark.timeout(600)
def test_jobs_of_a_viewer_that_was_killed_resume_or_are_said_to_have_failed(lives: JobLives) -> None:
    for seed in range(3):
        lives.live(seed)
    lives.live(99, kill=False)
    assert lives.tally.promised > 0 and set(lives.tally.states) <= set(OVER), lives.tally


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_job_is_lost_in_50_kills(lives: JobLives) -> None:
    for seed in range(50):
        lives.live(seed)
        print(lives.tally, flush=True)
    lives.live(99, kill=False)
    print(lives.tally)
    assert lives.tally.kills == 50 and lives.tally.running > 10 and lives.tally.resumed > 5, lives.tally
    assert set(lives.tally.states) <= set(OVER), lives.tally
