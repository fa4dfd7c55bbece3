"""Somebody at work in a tab without a browser, who notes what the page has called saved."""

import html
import random
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import viewer_victim
from viewer_victim import Widgets
from websockets.exceptions import ConnectionClosed

from carts_core.project import Key, ProjectState, ReviewState
from carts_viewer.picture.strokes import Target
from tools.raw_tab import RawTab

T = TypeVar("T")
CORNER = (2, 2)
"""A pixel where no arm is ever rendered."""
Holds = Callable[[ProjectState], bool]
"""Whether a state of the project has an edit."""


@dataclass(frozen=True)
class Acknowledged:
    """An edit that the page has called saved."""

    number: int
    """Of its step in the history."""
    name: str
    holds: Holds
    """For the state right after the step."""


@dataclass
class Client:
    """Somebody who edits frames in a tab, notes what the page called done, and starts runs and exports meanwhile."""

    tab: RawTab
    ids: Widgets
    frames: int
    """How many there are."""
    random: random.Random
    unique: Iterator[int]
    pixels: Iterator[tuple[int, int]]
    """Each comes once, so that painting it is always a step."""
    seen: list[Acknowledged] = field(default_factory=list)
    exported: set[Path] = field(default_factory=set)
    """What the page said is exported."""
    runs: int = 0
    strokes: int = 0
    exports: int = 0
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
            self.tab.set(self.ids.format, self.random.choice(viewer_victim.FORMATS))
            self.tab.set(self.ids.export, True)
            self.exports += 1

    def _edit(self) -> None:
        number, dice, frame = next(self.unique), self.random.random(), self.frame
        if dice < 0.4:
            # Never twice the same, nor what an earlier life left (their numbers lie a million apart, and all begin with
            # this edit), so that an old value cannot pass for a new one and each is a step.
            life, edit = divmod(number, 10**6)
            value = 5.0 - 0.002 * ((edit + 211 * life) % 5000)
            self._set(self.ids.joint, value, "Move PSM1 yaw", lambda state: _has_joint(state, frame, value))
        elif dice < 0.6:
            note = f"note {number}"
            self._set(self.ids.note, note, "Note", lambda state: state.review(frame).note == note)
        elif dice < 0.7:
            # Accepting what is accepted is no step, so both are asked for.
            for element, name, wanted in (
                (self.ids.accept, "Accept", ReviewState.ACCEPTED),
                (self.ids.reject, "Reject", ReviewState.REJECTED),
            ):
                self._set(
                    element, True, name, lambda state, wanted=wanted: state.review(frame).state is wanted, optional=True
                )
        elif dice < 0.85:
            pixel = next(self.pixels)
            self._paint(Target.IGNORE, pixel, "Ignore pixels", lambda state: _ignores(state, frame, pixel))
        else:
            # Nor is adding what is there.
            for erase, name in ((False, "Add to the mask"), (True, "Remove from the mask")):
                added = lambda state, erase=erase: _adds(state, frame, CORNER) is not erase  # noqa: E731
                self._paint(Target.MASK, CORNER, name, added, erase=erase, optional=True)

    def _paint(
        self,
        target: Target,
        pixel: tuple[int, int],
        name: str,
        holds: Holds,
        *,
        erase: bool = False,
        optional: bool = False,
    ) -> None:
        """Paint a dot as our page does; the rest as in `_ask`."""
        row, column = pixel
        stroke = {
            "number": next(self.unique),
            "frame": self.frame,
            "camera": "left",
            "target": target,
            "erase": erase,
            "polygon": False,
            "diameter": 1,
            "points": [[column + 0.5, row + 0.5]],
        }
        self._ask(lambda: self.tab.report("Painted", **stroke), name, holds, optional=optional)
        self.strokes += 1

    def _set(self, element: str, value: object, name: str, holds: Holds, *, optional: bool = False) -> None:
        self._ask(lambda: self.tab.set(element, value), name, holds, optional=optional)

    def _ask(self, edit: Callable[[], None], name: str, holds: Holds, *, optional: bool = False) -> None:
        """Edit the frame, let go, and wait until the page says that it is saved."""
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
