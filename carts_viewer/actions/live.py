"""Live streams: start, stop, and display of the newest result."""

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from carts_core import live, optimization
from carts_core.errors import CartsError
from carts_core.live import OpenStream, open_stream
from carts_core.live.messages import mounts_of
from carts_core.project import Provenance, Source
from carts_core.settings.live import StreamAddress, StreamKind
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.jobs.solver import scene_at
from carts_viewer.state import LiveState, Pose

if TYPE_CHECKING:
    from carts_core.live import LiveTracker, Recorder, Results, Tracked


class LiveRun:
    """A tracked live stream.

    Args:
        stream: source of frames, which also receives the results.
        tracker: tracks the arms.
        results: makes messages for the stream's clients.
        recorder: records frames and corrections; None for no recording.

    Attributes:
        statistics: throughput and latency.
        error: the error that ended the stream; None while it runs, and after a normal end.
    """

    def __init__(
        self, stream: OpenStream, tracker: "LiveTracker", results: "Results", recorder: "Recorder | None"
    ) -> None:
        self.statistics = live.LiveStatistics()
        self.error: Exception | None = None
        self.recorder = recorder
        self._stream, self._tracker, self._results = stream, tracker, results
        self._newest: Tracked | None = None
        self._changing = threading.Lock()
        self._thread = threading.Thread(target=self._follow, name="carts-live-tracker", daemon=True)
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether the stream has ended."""
        return not self._thread.is_alive()

    @property
    def port(self) -> int | None:
        """Port that receives joints or frames; None if not used."""
        return None if self._stream.server is None else self._stream.server.port

    def take(self) -> "Tracked | None":
        """The newest result; None if it was already taken."""
        with self._changing:
            newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        """End the stream and its thread; the recorder stays open."""
        self._stream.close()
        self._thread.join(10.0)

    def _follow(self) -> None:
        sinks = [self._show, *([self.recorder] if self.recorder is not None else [])]
        try:
            live.follow(self._stream.source, self._tracker, sinks, self.statistics)
        except Exception as error:  # `LiveHandler.advance` raises it on the worker's thread.
            self.error = error
        finally:
            self._stream.close()
            self._tracker.close()

    def _show(self, tracked: "Tracked") -> None:
        with self._changing:
            self._newest = tracked
        if self._stream.clients:
            message = self._results.message(tracked)
            for send in self._stream.clients:
                send(message)


_POLL_INTERVAL = 0.01
"""Interval between checks for a new result [s]."""
_STATISTICS_INTERVAL = 0.5
"""Interval between updates of the statistics [s]."""
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
        self._live: LiveRun | None = None
        self._tell_at = 0.0

    @property
    def active(self) -> bool:
        """Whether a stream is shown."""
        return self._live is not None

    def _on_StopLive(self, intent: intents.StopLive) -> None:
        self.stop("Stopped.")

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
        return _POLL_INTERVAL if self.active else None

    def advance(self) -> None:
        """Show the newest result, or stop after the end of the stream.

        Raises:
            CartsError: the error that ended the stream.
        """
        run = self._live
        if run is None:
            return
        over = run.over
        tracked = run.take()
        if tracked is not None:
            self._show_result(run, tracked)
        elif over:
            error = run.error
            self.stop("The stream has ended." if error is None else "The stream ended with an error.")
            if error is not None:
                raise error

    def stop(self, why: str) -> None:
        """Stop the stream, show the recording again, and close the recorder.

        Raises:
            CartsError: the recording of the stream could not be written.
        """
        run, self._live = self._live, None
        if run is None:
            return
        run.close()
        state = self._context.state.live
        assert state is not None
        text = f"{why} {run.statistics}."
        try:
            self._show(again=True)
        finally:
            # Changed only after the frame, so that a streamed frame is never shown as a frame of the recording.
            self._context.change(live=replace(state, on=False, text=text), scores=None, maps=None)
        if run.recorder is not None:
            path = run.recorder.close()
            kept = "Nothing was recorded." if path is None else f"Recorded: carts view {path}"
            self._context.change(live=replace(state, on=False, text=f"{text} {kept}"))

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
        extractor = self._optimizers.extractor()
        state, sequence, cameras = context.state, session.sequence, context.cameras
        folder = self._folder() if intent.record else None
        loops = _ENDLESS_LOOPS if intent.repeat else 1
        stream = open_stream(address, sequence, cameras, state.domain, rate=intent.rate, loops=loops)
        try:
            replayed = address.kind is StreamKind.REPLAY
            known = optimization.Backgrounds.of(sequence, cameras, state.domain) if replayed else None
            free = replace(state.free, base_frames=False, extrinsics=False, intrinsics=False)
            scene = scene_at(session.scene, session.measured(state.frame))
            tracker = live.LiveTracker(scene, extractor, free=free, backgrounds=known, cameras=cameras, concurrent=True)
            made_by = Provenance.made_by_optimizer({"live": True}, extractor.sha256)
            recorder = None if folder is None else live.Recorder(sequence, cameras, folder, made_by)
        except BaseException:
            stream.close()
            raise
        self._live = LiveRun(stream, tracker, live.Results(scene.with_cameras(cameras)), recorder)
        self._tell_at = 0.0
        port = self._live.port
        waits = f"Waiting for {'the first frame' if port is None else f'messages on port {port} of 127.0.0.1'}."
        context.change(live=LiveState(source=str(address), text=waits, busy=True), scores=None, maps=None, busy=None)

    def _folder(self) -> Path:
        """A new folder beside the project.

        Raises:
            CartsError: the project is read-only.
        """
        project = self._session.editor.project
        if not project.writable:
            raise CartsError("This project is read-only, so the stream cannot be recorded beside it. Untick Record.")
        return project.path.with_name(f"{project.path.stem}_live_{time.strftime('%Y%m%d_%H%M%S')}")

    def _show_result(self, run: LiveRun, tracked: "Tracked") -> None:
        context, estimate, shown = self._context, tracked.estimate, self._context.state.live
        assert shown is not None
        mounts = mounts_of(self._session.scene, tracked.stream_frame.frame, tracked.stream_frame.camera_poses)
        frame = replace(tracked.stream_frame.frame, mounts=mounts)
        measured = self._session.measured(frame)
        scene = self._session.with_joints(measured, dict(estimate.joint_positions))
        camera = context.state.camera if context.state.camera in frame.images else next(iter(frame.images))
        text = shown.text
        if time.monotonic() >= self._tell_at:
            self._tell_at = time.monotonic() + _STATISTICS_INTERVAL
            text = str(run.statistics)
        context.change(
            frame=frame,
            camera=camera,
            pose=Pose(scene, Source.OPTIMIZER),
            live=replace(shown, verdict=estimate.verdict.value, age=tracked.age, text=text, busy=False),
            scores=None,
            maps=None,
        )
