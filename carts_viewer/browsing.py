"""What intents about the picture do: which frame, domain, camera and layer are shown, and playing."""

import logging
import time
from dataclasses import replace
from functools import singledispatchmethod
from typing import TYPE_CHECKING

from carts_core.errors import SequenceError
from carts_core.project import Key, TimeOffset
from carts_viewer import intents as ask
from carts_viewer.checks import clamped, finite, one_of, unknown
from carts_viewer.state import RunState

if TYPE_CHECKING:
    from carts_viewer.controller import Controller

_log = logging.getLogger(__name__)
SPEEDS = (0.5, 60.0)
"""Slowest and fastest playing [frames/s]."""


class Browser:
    """The part of the controller that chooses what is shown."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._session = controller.session
        self._next_frame_at = 0.0

    @singledispatchmethod
    def handle(self, intent: ask.Browsing) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    def patience(self) -> float | None:
        """How long until the next frame is due [s]; None when nothing plays."""
        return max(0.0, self._next_frame_at - time.monotonic()) if self._controller.state.playing else None

    def advance(self) -> None:
        """Show the next frame, if it is due."""
        if self.patience() == 0.0:
            state = self._controller.state
            self._next_frame_at = time.monotonic() + 1.0 / state.fps
            self.show(index=(state.index + 1) % len(self._session.sequence))

    def show(
        self, *, index: int | None = None, domain: str | None = None, camera: str | None = None, again: bool = False
    ) -> None:
        """Go to another frame, domain or camera; out of range is clamped, an unknown name is refused.

        Args:
            index: of the frame.
            domain: its name.
            camera: its name.
            again: also if nothing of these changes.

        Raises:
            CartsError: a name is unknown, the image is not usable, or an unfinished edit could not be saved.
        """
        controller, state, sequence = self._controller, self._controller.state, self._session.sequence
        index = state.index if index is None else min(max(int(index), 0), len(sequence) - 1)
        domain = one_of(domain, state.domain, sequence.domains, "domain")
        camera = one_of(camera, state.camera, [own.name for own in sequence.scene.cameras], "camera")
        if not again and (index, domain, camera) == (state.index, state.domain, state.camera):
            return
        if (index, domain) != (state.index, state.domain) or (camera != state.camera and not state.every_camera):
            controller.end_run("Stopped: another image is shown")
        frame = self._session.frame(index, domain, camera)
        if index != state.index:
            controller.leave_frame()
            keypoints = replace(controller.state.keypoints, pins=(), residuals=())
            controller.change(run=RunState(), keypoints=keypoints)
        controller.change(index=index, domain=domain, camera=camera, frame=frame, scores=None, maps=None, error=None)
        controller.refresh()

    @handle.register
    def _(self, intent: ask.ShowFrame) -> None:
        self._controller.change(playing=False)
        self.show(index=intent.index)

    @handle.register
    def _(self, intent: ask.MoveFrame) -> None:
        self._controller.change(playing=False)
        self.show(index=self._controller.state.index + intent.by)

    @handle.register
    def _(self, intent: ask.Play) -> None:
        on = not self._controller.state.playing if intent.on is None else intent.on
        self._next_frame_at = time.monotonic()
        self._controller.change(playing=on)

    @handle.register
    def _(self, intent: ask.SetSpeed) -> None:
        self._controller.change(fps=clamped(intent.fps, *SPEEDS))

    @handle.register
    def _(self, intent: ask.SetTimeOffset) -> None:
        seconds, sequence = finite(intent.seconds), self._session.sequence
        try:
            sequence.with_time_offset(seconds)
        except SequenceError as error:
            if sequence.matching is None:
                raise
            # Half-typed numbers are often far off, so there is no alarm before the field is left.
            now = f"{sequence.matching.time_offset:g} s"
            text = f"With {seconds:g} s there are no joint positions near some frames in time, so it stays at {now}."
            _log.info("%s %s", text, error)
            self._controller.change(time_error=text)
            return
        self._controller.end_run("Stopped: the time offset was changed")
        self._controller.change(time_error=None)
        gesture = ask.SetTimeOffset
        self._controller.stage("Time offset", {Key.time_offset(): TimeOffset(seconds)}, gesture=gesture)

    @handle.register
    def _(self, intent: ask.ShowDomain) -> None:
        self.show(domain=intent.domain)

    @handle.register
    def _(self, intent: ask.ShowCamera) -> None:
        self.show(camera=intent.camera)

    @handle.register
    def _(self, intent: ask.ShowLayer) -> None:
        self._controller.change(layer=intent.layer)

    @handle.register
    def _(self, intent: ask.SetOpacity) -> None:
        self._controller.change(opacity=clamped(intent.opacity, 0.0, 1.0))
