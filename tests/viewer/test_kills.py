"""The app is killed at any moment: what the page has called saved is there afterwards, and nothing is half-written."""

import multiprocessing
import random
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import viewer_victim
from viewer_victim import Widgets
from websockets.exceptions import ConnectionClosed

from carts_core.data import Sequence
from carts_core.project import Project, ProjectState
from carts_viewer.raw_tab import RawTab

T = TypeVar("T")
FRAMES = 4


@dataclass(frozen=True)
class Acknowledged:
    """An edit that the page has called saved."""

    number: int
    """Of its step in the history."""
    name: str
    frame: int
    value: float | str

    def check(self, state: ProjectState) -> None:
        """Fail unless this state, the one after the step, has the edit."""
        if isinstance(self.value, float):
            there = state.joints(self.frame)["PSM1"].joint_positions[0]
            assert np.degrees(there) == pytest.approx(self.value, abs=1e-3), self
        else:
            review = state.review(self.frame)
            assert self.value in (review.note, str(review.state)), self


@dataclass
class Client:
    """Somebody who edits frames in a tab, notes what the page called saved, and starts runs and exports meanwhile."""

    tab: RawTab
    ids: Widgets
    random: random.Random
    unique: Callable[[], int]
    seen: list[Acknowledged] = field(default_factory=list)
    runs: int = 0
    exports: int = 0
    frame: int = 0

    def work(self) -> None:
        """Until the server is gone."""
        try:
            self._until(self._position)
            while True:
                self._edit()
        except ConnectionClosed:
            return

    def _edit(self) -> None:
        number, dice = self.unique(), self.random.random()
        if dice < 0.3:
            self.frame = self.random.randrange(FRAMES)
            self.tab.set(self.ids.frame, self.frame + 1)
        elif dice < 0.4:
            self.tab.set(self.ids.run, True)
            self.runs += 1
            time.sleep(0.1 * self.random.random())
        elif dice < 0.45:
            self.tab.set(self.ids.export, True)
            self.exports += 1
        # Never twice the same, so that an old value cannot pass for a new one.
        if self.random.random() < 0.5:
            value = 5.0 - 0.002 * (number % 5000)
            self._ask(self.ids.joint, value, "Move PSM1 yaw", value)
        elif self.random.random() < 0.5:
            self._ask(self.ids.note, f"note {number}", "Note", f"note {number}")
        else:
            # Accepting what is accepted is no step, so both are asked for.
            self._ask(self.ids.accept, True, "Accept", "accepted", optional=True)
            self._ask(self.ids.reject, True, "Reject", "rejected", optional=True)

    def _ask(self, element: str, value: object, name: str, kept: float | str, *, optional: bool = False) -> None:
        """Edit the frame, let go, and wait until the page says that it is saved."""
        before, _ = self._position() or (0, "")
        expected = f"{name}, frame {self.frame + 1:03d}"
        self.tab.set(element, value)
        self.tab.set(self.ids.released, f"client {self.unique()}")
        step = self._until(lambda: self._saved(before, expected), 0.5 if optional else 20.0)
        if step is not None:
            self.seen.append(Acknowledged(step, expected, self.frame, kept))
        else:
            assert optional, f"the page never called {expected} saved; it says {self._position()}, it was at {before}"

    def _saved(self, before: int, name: str) -> int | None:
        """The number of the newest step, if it has this name, is a new one, and the page says that it is saved."""
        saved = "<b>Saved</b>" in self.tab.widgets.get(self.ids.saved, {}).get("content", "")
        number, newest = self._position() or (0, "")
        return number if saved and number > before and newest == name else None

    def _position(self) -> tuple[int, str] | None:
        """Number and name of the newest step; None before the page has said so."""
        value = self.tab.widgets.get(self.ids.steps, {}).get("value", "")
        if value in ("Start", "As measured"):
            return 0, value
        found = re.fullmatch(r"(\d+)\. (.*)", value)
        return None if found is None else (int(found[1]), found[2])

    def _until(self, read: Callable[[], T | None], timeout: float = 20.0) -> T | None:
        """Wait for something that is not None; None when it does not come in that time [s]."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            found = read()
            if found is not None:
                return found
            if not self.tab.connected:
                raise ConnectionClosed(None, None)
            time.sleep(0.002)
        return None


@dataclass
class Tally:
    """What all lives of the app together saw."""

    kills: int = 0
    acknowledged: int = 0
    runs: int = 0
    page_exports: int = 0
    whole_exports: int = 0
    interrupted_exports: int = 0
    steps: int = 0


def _survive(kills: int, sequence_path: Path, weights: Path, exports: Path) -> Tally:
    processes = multiprocessing.get_context("forkserver")
    # Every life is forked from a process that has imported everything and done nothing.
    processes.set_forkserver_preload(["carts_viewer.app", "carts_core.export"])
    sequence = Sequence.open(sequence_path)
    project_path = sequence_path.with_suffix(".carts")
    exports.mkdir()
    before = {path.name for path in sequence_path.parent.iterdir()}
    tally, names, serial = Tally(), [], iter(range(1, 10**9))
    for seed in range(kills):
        ours, theirs = processes.Pipe(duplex=False)
        victim = processes.Process(target=viewer_victim.serve, args=(sequence_path, weights, exports, theirs))
        victim.start()
        theirs.close()
        assert ours.poll(120), "the app did not start"
        ids: Widgets = ours.recv()
        dice = random.Random(seed)
        with RawTab(ids.url, keep=1) as tab:
            client = Client(tab, ids, dice, lambda: next(serial))
            killer = threading.Timer(0.05 + 2.5 * dice.random(), victim.kill)
            killer.start()
            client.work()
            killer.join()
        victim.join()
        assert victim.exitcode == -9, f"the app ended by itself, with code {victim.exitcode}"
        names = _check_project(sequence, project_path, client.seen, names)
        tally.kills += 1
        tally.acknowledged += len(client.seen)
        tally.runs += client.runs
        tally.page_exports += client.exports
        for path in exports.iterdir():
            if path.name.startswith("."):
                tally.interrupted_exports += 1
            else:
                viewer_victim.check_whole(path, FRAMES)
                tally.whole_exports += 1
        # Nothing but the project's own files has appeared beside the sequence.
        new = {path.name for path in sequence_path.parent.iterdir()} - before
        assert new <= {project_path.name + end for end in ("", "-wal", "-shm", ".lock")}, new
    tally.steps = len(names)
    return tally


def _check_project(sequence: Sequence, path: Path, seen: list[Acknowledged], names: list[str]) -> list[str]:
    """Open the project as the next server would, and check this life's edits; gives the names of all steps."""
    with Project.open(sequence, path) as project:
        assert project.writable
        steps = [step.name for step in project.state.steps]
        assert steps[: len(names)] == names, "steps of earlier lives have changed"
        assert project.state.position == len(steps)
        for edit in seen:
            assert steps[edit.number - 1 : edit.number] == [edit.name], edit
            project.go_to(edit.number)
            edit.check(project.state)
        project.go_to(len(steps))
    return steps


def test_nothing_that_the_page_called_saved_is_lost_when_the_app_is_killed(
    tiny_sequence: Callable[..., Path], untrained_weights: Path, tmp_path: Path
) -> None:
    tally = _survive(6, tiny_sequence(frames=FRAMES), untrained_weights, tmp_path / "exports")
    assert tally.kills == 6 and tally.acknowledged > 6 and tally.whole_exports > 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_nothing_is_lost_in_200_kills(
    tiny_sequence: Callable[..., Path], untrained_weights: Path, tmp_path: Path
) -> None:
    tally = _survive(200, tiny_sequence(frames=FRAMES), untrained_weights, tmp_path / "exports")
    print(tally)
    assert tally.kills == 200 and tally.acknowledged > 200 and tally.runs > 20 and tally.interrupted_exports > 20
