"""The app is killed at any moment: what the page has called saved is there afterwards, and nothing is half-written."""

import multiprocessing
import random
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
import viewer_victim
from viewer_client import Client
from viewer_victim import Widgets

from carts_core.project import Project
from carts_core.recording import Sequence
from tools.raw_tab import RawTab

FRAMES = 24
WIDTH, HEIGHT = 96, 72


@dataclass
class Tally:
    """What all lives of the app together saw."""

    kills: int = 0
    acknowledged: int = 0
    steps: int = 0
    runs: int = 0
    strokes: int = 0
    exports: int = 0
    acknowledged_exports: int = 0
    whole_exports: int = 0
    interrupted_exports: int = 0


class Lives:
    """One project through many lives of the app, each of which ends with a kill."""

    def __init__(self, sequence_path: Path, weights: Path) -> None:
        self._sequence_path, self._weights = sequence_path, weights
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
        self._processes = multiprocessing.get_context("forkserver")
        # Every life is forked from a process that has imported everything and done nothing.
        self._processes.set_forkserver_preload(["carts_viewer.app"])
        self.tally = Tally()

    def live(self, seed: int) -> None:
        """Work in a new process until it is killed, and look what is left."""
        ours, theirs = self._processes.Pipe(duplex=False)
        # A daemon, so that a test that fails before the kill does not keep pytest from ending.
        victim = self._processes.Process(
            target=viewer_victim.serve, args=(self._sequence_path, self._weights, theirs), daemon=True
        )
        victim.start()
        theirs.close()
        assert ours.poll(120), "the app did not start"
        url = ours.recv()
        dice = random.Random(seed)
        with RawTab(url, keep=1) as tab:
            ids: Widgets = ours.recv()
            client = Client(tab, ids, FRAMES, dice, self._unique, self._pixels)
            killer = threading.Timer(0.05 + 2.5 * dice.random(), victim.kill)
            killer.start()
            client.work()
            killer.join()
        victim.join()
        assert victim.exitcode == -9, f"the app ended by itself, with code {victim.exitcode}"
        self._check_project(client)
        self._check_exports()
        self.tally.kills += 1
        self.tally.acknowledged += len(client.seen)
        self.tally.steps = len(self._names)
        self.tally.runs += client.runs
        self.tally.strokes += client.strokes
        self.tally.exports += client.exports
        self.tally.acknowledged_exports += len(client.exported)

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
                viewer_victim.check_whole(path, FRAMES)
                self.tally.whole_exports += 1
        project_files = {self._project_path.name + end for end in ("", "-wal", "-shm")}
        project_files.add(f"{self._project_path.stem}_jobs.json")
        new = {path.name for path in self._sequence_path.parent.iterdir()} - self._beside
        assert new <= project_files, new


@pytest.fixture
def lives(tiny_sequence: Callable[..., Path], untrained_weights: Path) -> Lives:
    return Lives(tiny_sequence(frames=FRAMES, width=WIDTH, height=HEIGHT), untrained_weights)


def test_nothing_that_the_page_called_saved_is_lost_when_the_app_is_killed(lives: Lives) -> None:
    for seed in range(6):
        lives.live(seed)
    tally = lives.tally
    assert tally.acknowledged > 6 and tally.strokes > 0 and tally.whole_exports > 0, tally


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_is_lost_in_200_kills(lives: Lives) -> None:
    for seed in range(200):
        lives.live(seed)
    tally = lives.tally
    print(tally)
    assert tally.acknowledged > 200 and tally.strokes > 50 and tally.runs > 20, tally
    assert tally.acknowledged_exports > 20 and tally.interrupted_exports > 20, tally
