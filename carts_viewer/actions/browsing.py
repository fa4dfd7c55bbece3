"""Browsing: the shown frame, domain, camera and layer, and playback."""

import logging
import time
from dataclasses import replace
from typing import Any

from carts_core.errors import SequenceError
from carts_core.project import Key, TimeOffset
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler, clamped, finite, one_of
from carts_viewer.state import Reach, RunState

_log = logging.getLogger(__name__)
SPEEDS = (0.5, 60.0)
"""Minimum and maximum playback speed [frames/s]."""


class BrowsingHandler(Handler):
    """Handler of the shown frame, camera, domain and layer, and of playback."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._next_frame_at = 0.0

    def wait_time(self) -> float | None:
        """Time until the next frame is due [s]; None without playback."""
        return max(0.0, self._next_frame_at - time.monotonic()) if self._context.state.playing else None

    def advance(self) -> None:
        """Show the next frame, if it is due."""
        if self.wait_time() == 0.0:
            state = self._context.state
            self._next_frame_at = time.monotonic() + 1.0 / state.fps
            first, last = state.range or (0, len(self._session.sequence) - 1)
            self.show(index=state.index + 1 if first <= state.index < last else first)

    def show(
        self, *, index: int | None = None, domain: str | None = None, camera: str | None = None, again: bool = False
    ) -> None:
        """Show another frame, domain or camera, or reload the same frame with `again`; indices are clamped.

        Raises:
            CartsError: a name is unknown, the image is not usable, or an unfinished edit could not be saved.
        """
        context, state, sequence = self._context, self._context.state, self._session.sequence
        index = state.index if index is None else min(max(int(index), 0), len(sequence) - 1)
        domain = one_of(domain, state.domain, sequence.domains, "domain")
        camera = one_of(camera, state.camera, [own.name for own in sequence.scene.cameras], "camera")
        if not again and (index, domain, camera) == (state.index, state.domain, state.camera):
            return
        if (index, domain) != (state.index, state.domain) or (camera != state.camera and not state.every_camera):
            self._context.end_run("Stopped: another image was selected")
        frame = self._session.frame(index, domain, camera)
        if index != state.index:
            context.leave_frame()
            if context.run is not None:
                context.run.forget()
            keypoints = replace(context.state.keypoints, pins=(), residuals=())
            context.change(run=RunState(), keypoints=keypoints)
        context.change(index=index, domain=domain, camera=camera, frame=frame, scores=None, maps=None)
        context.change(error=None, notice=None)
        context.refresh()

    def _on_ShowFrame(self, intent: intents.ShowFrame) -> None:
        self._context.change(playing=False)
        self.show(index=intent.index)

    def _on_MoveFrame(self, intent: intents.MoveFrame) -> None:
        self._context.change(playing=False)
        self.show(index=self._context.state.index + intent.by)

    def _on_Play(self, intent: intents.Play) -> None:
        on = not self._context.state.playing if intent.on is None else intent.on
        self._next_frame_at = time.monotonic()
        self._context.change(playing=on)

    def _on_SetSpeed(self, intent: intents.SetSpeed) -> None:
        self._context.change(fps=clamped(intent.fps, *SPEEDS))

    def _on_SetTimeOffset(self, intent: intents.SetTimeOffset) -> None:
        seconds, sequence = finite(intent.seconds), self._session.sequence
        try:
            sequence.with_time_offset(seconds)
        except SequenceError as error:
            if sequence.matching is None:
                raise
            # Half-typed numbers are often far off, so no error is shown before the field is left.
            now = f"{sequence.matching.time_offset:g} s"
            text = f"With {seconds:g} s, some frames have no joint positions at their times. The offset remains {now}."
            _log.info("%s %s", text, error)
            self._context.change(time_error=text)
            return
        self._context.end_run("Stopped: the time offset was changed")
        self._context.change(time_error=None)
        gesture = intents.SetTimeOffset
        self._context.edit("Time offset", {Key.time_offset(): TimeOffset(seconds)}, gesture=gesture)

    def _on_ShowDomain(self, intent: intents.ShowDomain) -> None:
        self.show(domain=intent.domain)

    def _on_ShowCamera(self, intent: intents.ShowCamera) -> None:
        self.show(camera=intent.camera)

    def _on_ShowBeside(self, intent: intents.ShowBeside) -> None:
        self._context.change(beside=not self._context.state.beside if intent.on is None else intent.on)

    def _on_ShowLoupe(self, intent: intents.ShowLoupe) -> None:
        self._context.change(loupe=not self._context.state.loupe if intent.on is None else intent.on)

    def _on_SetReach(self, intent: intents.SetReach) -> None:
        self._context.change(reach=Reach(intent.reach))

    def _on_SetRange(self, intent: intents.SetRange) -> None:
        end = len(self._session.sequence) - 1
        first, last = sorted(min(max(int(one), 0), end) for one in intent.frames or (0, end))
        self._context.change(range=None if (first, last) == (0, end) else (first, last))

    def _on_MarkRange(self, intent: intents.MarkRange) -> None:
        index, end = self._context.state.index, len(self._session.sequence) - 1
        first, last = self._context.state.range or (0, end)
        # A new end before the current start resets the start; a new start after the current end resets the end.
        if intent.end:
            self.handle(intents.SetRange((first if first <= index else 0, index)))
        else:
            self.handle(intents.SetRange((index, last if last >= index else end)))

    def _on_CompareWith(self, intent: intents.CompareWith) -> None:
        self._compare(mode=intent.mode, left=intent.left, right=intent.right)

    def _on_SetSwipe(self, intent: intents.SetSwipe) -> None:
        self._compare(swipe=clamped(intent.share, 0.0, 1.0))

    def _on_Peek(self, intent: intents.Peek) -> None:
        self._compare(peek=bool(intent.on))

    def _compare(self, **changes: Any) -> None:
        self._context.change(compare=replace(self._context.state.compare, **changes))

    def _on_ShowLayer(self, intent: intents.ShowLayer) -> None:
        self._context.change(layer=intent.layer)

    def _on_SetOpacity(self, intent: intents.SetOpacity) -> None:
        self._context.change(opacity=clamped(intent.opacity, 0.0, 1.0))
