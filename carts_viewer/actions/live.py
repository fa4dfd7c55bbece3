"""Live streams: start, stop, and display of the newest result."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from carts_core.errors import CartsError
from carts_core.project import Source
from carts_core.settings.live import CURRENT, StreamAddress, StreamKind
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler
from carts_viewer.jobs.live_stream import LiveEnded, LiveResult, LiveStep, LiveTask
from carts_viewer.jobs.optimizers import OptimizerFactory, wait_for
from carts_viewer.jobs.solver_process import Reply, Run
from carts_viewer.state import LiveState, Pose

_STATISTICS_INTERVAL = 0.5
"""Interval between updates of the statistics [s]."""
_PATIENCE, _LONGEST_PATIENCE = 0.5, 2.0
"""Minimum and maximum time without a result after which the shown result is outdated [s]; in between, `CURRENT` frame
intervals."""
_ENDLESS_LOOPS = 1_000_000
ALLOWED_WHILE_LIVE = (
    intents.StartLive,
    intents.StopLive,
    intents.ShowLayer,
    intents.SetOpacity,
    intents.ShowBeside,
    intents.CompareWith,
    intents.SetSwipe,
    intents.Peek,
    intents.Refresh,
    intents.Drawn,
    intents.Released,
    intents.SetName,
    intents.SetKeys,
    intents.ShowLoupe,
    intents.DismissError,
    intents.CancelJob,
)
"""Classes of intents that are allowed while a stream is shown."""


class ShowRecording(Protocol):
    """Function that shows the recording again."""

    def __call__(self, *, again: bool) -> None:
        """See `BrowsingHandler.show`."""


class LiveHandler(Handler):
    """Handler of live streams, which are shown in place of the recording."""

    def __init__(self, context: Context, optimizers: OptimizerFactory, show: ShowRecording) -> None:
        super().__init__(context)
        self._optimizers, self._show = optimizers, show
        self._live: Run[LiveStep | LiveEnded] | None = None
        self._reply: Reply[LiveStep | LiveEnded | None] | None = None
        self._tell_at = 0.0
        self._stopping = False
        """Whether the stream was asked to end."""
        self._arrived, self._patience = 0.0, _LONGEST_PATIENCE
        """Time of the newest result [s, monotonic], and time without a result after which it is outdated [s]."""

    @property
    def active(self) -> bool:
        """Whether a stream is shown."""
        return self._live is not None

    def _on_StopLive(self, intent: intents.StopLive) -> None:
        self.end_soon()

    def end_soon(self) -> None:
        """End the stream, if any, at the next step."""
        shown = self._context.state.live
        if self.active and shown is not None:
            # The solver may take a while to answer.
            self._stopping = True
            self._context.change(live=replace(shown, text="Stopping."))

    def replaces(self, intent: intents.Intent) -> bool:
        """Carry out an intent that has another meaning during a stream; returns whether it was carried out.

        Raises:
            CartsError: the intent is not allowed during a stream.
        """
        if not self.active or isinstance(intent, ALLOWED_WHILE_LIVE):
            return False
        state = self._context.state
        if isinstance(intent, intents.ShowCamera) and intent.camera in state.frame.images:
            self._context.change(camera=intent.camera, scores=None)
            return True
        if isinstance(intent, intents.Play) and intent.on is False:
            return True
        raise CartsError("A live stream cannot be edited. Press Stop (Live) first.")

    def wait_time(self) -> float | None:
        """Time until the next check for a result [s]; None if no stream is shown."""
        return wait_for(self._reply) if self.active else None

    def advance(self) -> None:
        """Show the newest result, or the recording after the end of the stream.

        Raises:
            CartsError: the error that ended the stream.
        """
        if self._live is None or self._reply is None:
            return
        self._notice_silence()
        if not self._reply.done:
            return
        try:
            found = self._reply.result()
        except Exception:
            self._show_recording("The stream ended with an error.")
            raise
        if not isinstance(found, LiveStep):
            self._end(found, "Stopped." if self._stopping else "The stream has ended.")
            return
        if self._stopping:
            self._reply = self._live.next(True)
            return
        self._reply = self._live.next()
        shown = self._context.state.live
        assert shown is not None
        if shown.busy:
            waits = f"Waiting for {'the first frame' if found.port is None else f'messages on port {found.port}'}."
            if shown.text != waits:
                self._context.change(live=replace(shown, text=waits))
        if found.newest is not None:
            self._show_result(found.newest, found.text)

    def _notice_silence(self) -> None:
        """Mark the shown result as outdated if no newer result arrives."""
        shown, silent = self._context.state.live, time.monotonic() - self._arrived
        if shown is None or shown.busy or silent < self._patience:
            return
        if silent - shown.silent >= _STATISTICS_INTERVAL or shown.silent == 0.0:
            self._context.change(live=replace(shown, silent=silent))

    def stop(self, why: str) -> None:
        """Stop the stream, show the recording again, and close the recorder.

        Raises:
            CartsError: the recording of the stream could not be written.
        """
        run, reply = self._live, self._reply
        if run is None:
            return
        found = None
        try:
            found = None if reply is None else reply.result()
            while isinstance(found, LiveStep):
                found = run.next(True).result()
        except BaseException:
            self._show_recording(why)
            raise
        self._end(found, why)

    def _end(self, ended: LiveEnded | None, why: str) -> None:
        if ended is None:
            self._show_recording(why)
            return
        text = f"{'The stream ended with an error.' if ended.error else why} {ended.text}."
        if ended.recorded is not None:
            text += f" Recorded: carts view {ended.recorded}"
        self._show_recording(text)
        if ended.error:
            raise CartsError(ended.error)

    def _show_recording(self, text: str) -> None:
        run, self._live, self._reply = self._live, None, None
        state = self._context.state.live
        assert run is not None and state is not None
        run.close()
        try:
            self._show(again=True)
        finally:
            # Changed only after the frame, so that a streamed frame is never shown as a frame of the recording.
            self._context.change(live=replace(state, on=False, text=text), scores=None, maps=None)

    def _on_StartLive(self, intent: intents.StartLive) -> None:
        context, session = self._context, self._session
        address = StreamAddress.parse(intent.source, intent.joints_port)
        if address.kind in (StreamKind.VIDEO, StreamKind.FOLDER):
            raise CartsError(
                f"{address.kind} is available on the command line only: carts live SEQUENCE --source {address}"
            )
        self.stop("Stopped.")
        self._context.end_run("Stopped: a live stream was started")
        context.save()
        context.change(playing=False, error=None)
        state, cameras = context.state, context.cameras
        free = replace(state.free, base_frames=False, extrinsics=False, intrinsics=False)
        folder, loops = self._folder() if intent.record else None, _ENDLESS_LOOPS if intent.repeat else 1
        measured = session.measured(state.frame)
        task = LiveTask(session.sequence, address, cameras, state.domain, measured, free, intent.rate, loops, folder)
        self._live = self._optimizers.live(task)
        self._reply, self._tell_at, self._stopping = self._live.next(), 0.0, False
        starts = LiveState(source=str(address), text="Starting.", busy=True)
        context.change(live=starts, scores=None, maps=None, busy=None)

    def _folder(self) -> Path:
        """A new folder beside the project.

        Raises:
            CartsError: the project is read-only.
        """
        project = self._session.editor.project
        if not project.writable:
            raise CartsError("This project is read-only, so the stream cannot be recorded beside it. Untick Record.")
        return project.path.with_name(f"{project.path.stem}_live_{time.strftime('%Y%m%d_%H%M%S')}")

    def _show_result(self, found: LiveResult, statistics: str) -> None:
        context, frame, shown = self._context, found.frame, self._context.state.live
        assert shown is not None
        scene = self._session.with_joints(self._session.measured(frame), dict(found.joint_positions))
        camera = context.state.camera if context.state.camera in frame.images else next(iter(frame.images))
        text = shown.text
        if time.monotonic() >= self._tell_at:
            self._tell_at = time.monotonic() + _STATISTICS_INTERVAL
            text = statistics
        self._arrived = time.monotonic()
        self._patience = min(max(CURRENT * found.interval, _PATIENCE), _LONGEST_PATIENCE)
        now = {"verdict": found.verdict, "age": found.age, "current": found.current, "silent": 0.0}
        context.change(
            frame=frame,
            camera=camera,
            pose=Pose(scene, Source.OPTIMIZER),
            live=replace(shown, **now, text=text, busy=False),
            scores=None,
            maps=None,
        )
