"""Viewers in separate processes that are killed, their clients, and the expected files."""

import html
import io
import json
import multiprocessing
import random
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from viewer_tab import run_without_end
from waiting import eventually
from websockets.exceptions import ConnectionClosed

from carts_core.files import MARKER
from carts_core.project import Key, ProjectState, ReviewState
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.panels.import_export import ExportPanel
from carts_viewer.panels.project import SavedPanel
from carts_viewer.picture.strokes import Target
from carts_viewer.serving import serve
from carts_viewer.state import ViewState
from tools.raw_tab import RawTab

T = TypeVar("T")
FORMATS = ("PNG masks", "COCO", "Kinematics, CSV")
"""Labels of the exported formats."""
JOB_FORMATS = ("masks", "coco", "csv")
CORNER = (2, 2)
"""A pixel where no arm is ever rendered."""
Holds = Callable[[ProjectState], bool]
"""Whether a state of the project has an edit."""


class Widgets(NamedTuple):
    """Address of the app, and ids of its widgets."""

    url: str
    saved: str
    result: str
    frame: str
    joint: str
    note: str
    accept: str
    reject: str
    run: str
    format: str
    export: str
    steps: str


def begin(target: Callable[..., None], *arguments: Any) -> tuple[ForkServerProcess, Connection]:
    """Start a process forked from one with all imports; returns the process and its pipe."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["carts_viewer.app"])
    ours, theirs = processes.Pipe(duplex=False)
    # A daemon, so that a test that fails before the kill does not keep pytest from ending.
    victim = processes.Process(target=target, args=(*arguments, theirs), daemon=True)
    victim.start()
    theirs.close()
    assert ours.poll(120), "the viewer did not start"
    return victim, ours


def serve_until_signal(sequence: Path, weights: Path, tell: Connection) -> None:
    """`carts view` with known widgets of the page; sends its address, its widgets and "ready"."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    opened = ViewerApp.open

    def open_and_tell(*_: object, **__: object) -> ViewerApp:
        app = opened(sequence, port=0, weights=(weights,))
        assert app.project.writable, app.notice
        # A run that ends by itself would leave nothing to be killed in the middle of.
        run_without_end(app)
        tell.send(app.url)
        # The widgets are those of the tab that comes now.
        eventually(lambda: app.tabs.first.view is not None, timeout=60)
        (saved,) = (panel for panel in app.view.display._panels if isinstance(panel, SavedPanel))
        (exports,) = (panel for panel in app.view.display._panels if isinstance(panel, ExportPanel))
        labels = "Note", "Accept", "Reject", "Run", "Format", "Export", "Go to"
        found = [
            *(saved._text, exports._result, app.view.page.find("Frame"), app.view.layout.joints.slider("PSM1", 0)),
            *map(app.view.page.find, labels),
        ]
        tell.send(Widgets(app.url, *map(app.page.element_id, found)))
        return app

    class Output(io.StringIO):
        def write(self, text: str) -> int:
            if "Ready" in text:
                tell.send("ready")
            return len(text)

    ViewerApp.open = open_and_tell  # pyright: ignore[reportAttributeAccessIssue]
    with redirect_stdout(Output()):
        serve(sequence, port=0)


def queue_jobs(sequence: Path, weights: Path, seed: int, more: bool, tell: Connection) -> None:
    """Open the viewer, queue jobs now and then while edits go on, and tell the state of every job that changes.

    Args:
        sequence: the recording.
        weights: of a small network.
        seed: of what is done.
        more: whether to queue more; otherwise what waits is finished, and the viewer ends by itself.
        tell: gets lists of (number, kind, state) whenever they change.
    """
    torch.set_num_threads(1)
    dice = random.Random(seed)
    app = ViewerApp.open(sequence, port=0, weights=(weights,))
    app.queue.put(intents.SetSetting("solver", "surface"))
    said: list[tuple[int, str, str]] = []
    tell.send(said)
    end = time.monotonic() + 240
    while time.monotonic() < end:
        state = app.state
        now = [(job.number, job.kind, str(job.state)) for job in state.jobs]
        if now != said:
            said = now
            tell.send(now)
        if more:
            _edit_or_queue(app, state, dice)
        elif now and all(kind in ("done", "failed", "cancelled") for _, _, kind in now):
            break
        time.sleep(0.02)
    app.close()
    tell.send(None)


def _edit_or_queue(app: ViewerApp, state: ViewState, dice: random.Random) -> None:
    """Mostly look and edit, and queue a job where fewer than four wait."""
    what = dice.random()
    if what < 0.5:
        app.queue.put(intents.ShowFrame(dice.randrange(len(app.sequence))))
    elif what < 0.7:
        app.queue.put(intents.Perturb(dice.uniform(0.1, 3.0), dice.randrange(1000)))
    elif what < 0.75:
        app.queue.put(intents.SetReview(dice.choice((ReviewState.ACCEPTED, ReviewState.UNTOUCHED))))
    elif sum(not job.over for job in state.jobs) < 4:
        exports = [intents.Export(dice.choice(JOB_FORMATS), "All")] * 2
        queued = [intents.OptimizeFrames("all"), intents.Solve(whole=True), intents.Calibrate(2), *exports]
        app.queue.put(dice.choice(queued))


def check_whole(path: Path, frames: int) -> None:
    """Fail unless what has this final name is a whole export."""
    if path.suffix == ".csv":
        assert len(path.read_text().splitlines()) == frames + 1, path
        return
    assert len(json.loads((path / MARKER).read_text())["views"]) == frames, f"{path} is not finished"
    annotations = path / "annotations" / "instances_default.json"
    if annotations.exists():
        assert len(json.loads(annotations.read_text())["images"]) == frames, path
        return
    folders = ("binary", "arms", "parts", "links")
    assert json.loads((path / "labels.json").read_text()).keys() == set(folders), path
    for folder in folders:
        pictures = list((path / folder).iterdir())
        assert len(pictures) == frames, path / folder
        for picture in pictures:
            assert cv2.imread(str(picture), cv2.IMREAD_UNCHANGED) is not None, picture


@dataclass(frozen=True)
class Acknowledged:
    """An edit that the page has called saved: number and name of its step, and whether a state has it."""

    number: int
    name: str
    holds: Holds


@dataclass
class Client:
    """Edits frames in a tab without a browser, notes what the page called saved, and starts runs and exports meanwhile.

    Attributes:
        frames: how many there are.
        pixels: each comes once, so that painting it is always a step.
        seen: edits that the page called saved.
        exported: paths that the page called exported.
    """

    tab: RawTab
    ids: Widgets
    frames: int
    random: random.Random
    unique: Iterator[int]
    pixels: Iterator[tuple[int, int]]
    seen: list[Acknowledged] = field(default_factory=list)
    exported: set[Path] = field(default_factory=set)
    runs: int = 0
    strokes: int = 0
    frame: int = 0

    def work(self) -> None:
        """Until the server is gone."""
        try:
            self._until(self._position)
            while True:
                self._disturb()
                self._edit()
        except ConnectionClosed:
            return

    def _disturb(self) -> None:
        """Go to another frame, start a run, or an export while there is none."""
        dice = self.random.random()
        if dice < 0.3:
            self.frame = self.random.randrange(self.frames)
            self.tab.set(self.ids.frame, self.frame + 1)
        elif dice < 0.4:
            self.tab.set(self.ids.run, True)
            self.runs += 1
            time.sleep(0.1 * self.random.random())
        elif not self.tab.widgets.get(self.ids.export, {}).get("disabled"):
            self.tab.set(self.ids.format, self.random.choice(FORMATS))
            self.tab.set(self.ids.export, True)

    def _edit(self) -> None:
        number, dice, frame, ids = next(self.unique), self.random.random(), self.frame, self.ids
        if dice < 0.4:
            # Never twice the same, nor what an earlier life left: an old value cannot pass for a new one.
            # Setting what a slider shows, with two decimals, is no edit.
            value = round(5.0 - 0.01 * (number % 5000), 2)
            self._set(ids.joint, value, "Move PSM1 yaw", lambda state: _has_joint(state, frame, value))
        elif dice < 0.6:
            note = f"note {number}"
            self._set(ids.note, note, "Note", lambda state: state.review(frame).note == note)
        elif dice < 0.7:
            # Accepting what is accepted is no step, so both are asked for.
            for element, name, wanted in (
                (ids.accept, "Accept", ReviewState.ACCEPTED),
                (ids.reject, "Reject", ReviewState.REJECTED),
            ):
                holds = lambda state, wanted=wanted: state.review(frame).state is wanted  # noqa: E731
                self._set(element, True, name, holds, optional=True)
        elif dice < 0.85:
            pixel = next(self.pixels)
            self._paint(Target.IGNORE, pixel, "Ignore pixels", lambda state: _ignores(state, frame, pixel))
        else:
            # Nor is adding what is there.
            for erase, name in ((False, "Add to the mask"), (True, "Remove from the mask")):
                added = lambda state, erase=erase: _adds(state, frame, CORNER) is not erase  # noqa: E731
                self._paint(Target.MASK, CORNER, name, added, erase=erase, optional=True)

    def _paint(
        self, target: Target, pixel: tuple[int, int], name: str, holds: Holds, *, erase: bool = False, optional=False
    ) -> None:
        """Paint a dot as the page does; the rest as in `_ask`."""
        row, column = pixel
        stroke = {"number": next(self.unique), "frame": self.frame, "camera": "left", "target": target, "erase": erase}
        stroke |= {"polygon": False, "diameter": 1, "points": [[column + 0.5, row + 0.5]]}
        self._ask(lambda: self.tab.report("Painted", **stroke), name, holds, optional=optional)
        self.strokes += 1

    def _set(self, element: str, value: object, name: str, holds: Holds, *, optional: bool = False) -> None:
        self._ask(lambda: self.tab.set(element, value), name, holds, optional=optional)

    def _ask(self, edit: Callable[[], None], name: str, holds: Holds, *, optional: bool = False) -> None:
        """Edit the frame, release, and wait until the page shows that it is saved."""
        before, _ = self._position() or (0, "")
        expected = f"{name}, frame {self.frame + 1:03d}"
        edit()
        self.tab.report("Released")
        step = self._until(lambda: self._saved(before, expected), 0.5 if optional else 20.0)
        if step is not None:
            self.seen.append(Acknowledged(step, expected, holds))
        else:
            assert optional, f"the page never called {expected} saved; it says {self._position()}, it was at {before}"

    def _saved(self, before: int, name: str) -> int | None:
        """Number of the newest step, if it has this name, is new, and the page shows that it is saved."""
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
            result = self.tab.widgets.get(self.ids.result, {}).get("content", "")
            self.exported |= {Path(html.unescape(path)) for path in re.findall("<code>(.*)</code>", result)}
            if found is not None:
                return found
            if not self.tab.connected:
                raise ConnectionClosed(None, None)
            time.sleep(0.002)
        return None


def _has_joint(state: ProjectState, frame: int, degrees: float) -> bool:
    return abs(np.degrees(state.joints(frame)["PSM1"].joint_positions[0]) - degrees) < 1e-3


def _ignores(state: ProjectState, frame: int, pixel: tuple[int, int]) -> bool:
    region = state.get(Key.ignore_region(frame, "left"))
    return region is not None and bool(region.region()[pixel])


def _adds(state: ProjectState, frame: int, pixel: tuple[int, int]) -> bool:
    correction = state.get(Key.mask_correction(frame, "left"))
    return correction is not None and bool(correction.added()[pixel])
