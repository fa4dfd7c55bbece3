"""A tracked live stream of the solver, whose newest results are sent to the page."""

import threading
import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from carts_core import live, optimization
from carts_core.errors import CartsError
from carts_core.live.messages import mounts_of
from carts_core.model.scene import Scene, SceneState
from carts_core.project import Provenance
from carts_core.recording import Frame, Sequence
from carts_core.settings import FreeParameters
from carts_core.settings.live import StreamAddress, StreamKind

if TYPE_CHECKING:
    from carts_core.live import LiveTracker, OpenStream, Recorder, Results, Tracked
    from carts_core.networks import FeatureExtractor

_WAIT = 0.1
"""Maximum waiting time for a result, so that other requests are answered in the meantime [s]."""
_STATISTICS_INTERVAL = 0.5
"""Interval of the statistics [s]; they take milliseconds after an hour."""


@dataclass(frozen=True, eq=False)
class LiveTask:
    """A stream to track."""

    sequence: Sequence
    address: StreamAddress
    cameras: tuple[str, ...]
    domain: str
    state: SceneState
    """State with the calibration."""
    free: FreeParameters
    rate: float | None
    """Frame rate of a replay [1/s]; None for that of the recording."""
    loops: int
    folder: Path | None
    """New folder in which the stream is recorded; None for no recording."""


@dataclass(frozen=True, eq=False)
class LiveResult:
    """Frame of a stream with its estimate."""

    frame: Frame
    joint_positions: Mapping[str, Float[np.ndarray, " dofs"]]
    verdict: str
    age: float
    """Latency [s]."""
    interval: float
    """Mean time between recent frames [s]; infinite if unknown."""
    current: bool
    """Whether the latency is at most two frame intervals."""


@dataclass(frozen=True, eq=False)
class LiveStep:
    """State of a running stream."""

    text: str
    """Statistics, as text for the user."""
    port: int | None
    """Port that receives joints or frames; None if not used."""
    newest: LiveResult | None = None
    """Newest result; None if it was already sent."""


@dataclass(frozen=True)
class LiveEnded:
    """Last answer of a stream."""

    text: str
    recorded: Path | None
    """Recorded sequence file."""
    error: str | None
    """Error that ended the stream."""


def tracked_stream(
    task: LiveTask, scene: Scene, extractor: "FeatureExtractor"
) -> Generator[LiveStep | LiveEnded, bool | None, None]:
    """Track a stream until it ends, or until a true value is sent in; yields `LiveStep`s and `LiveEnded`.

    Raises:
        CartsError: the stream cannot be opened, or the recording cannot be written.
    """
    sequence, cameras = task.sequence, task.cameras
    stream = live.open_stream(task.address, sequence, cameras, task.domain, rate=task.rate, loops=task.loops)
    try:
        replayed = task.address.kind is StreamKind.REPLAY
        known = optimization.Backgrounds.of(sequence, cameras, task.domain) if replayed else None
        tracker = live.LiveTracker(
            scene, extractor, free=task.free, backgrounds=known, cameras=cameras, concurrent=True
        )
        made_by = Provenance.made_by_optimizer({"live": True}, extractor.sha256)
        recorder = None if task.folder is None else live.Recorder(sequence, cameras, task.folder, made_by)
        run = _Follower(stream, tracker, live.Results(scene.with_cameras(cameras)), recorder)
    except BaseException:
        stream.close()
        raise
    port = None if stream.server is None else stream.server.port
    try:
        stop, text, due = (yield LiveStep("", port)), "", 0.0
        while not stop and not run.over:
            taken = run.take()
            if time.monotonic() >= due:
                text, due = str(run.statistics), time.monotonic() + _STATISTICS_INTERVAL
            stop = yield LiveStep(text, port, taken and _result(sequence.scene, taken))
    finally:
        stream.close()
        run.join(10.0)
        tracker.close()
    recorded, text = None if recorder is None else recorder.close(), str(run.statistics)
    if recorder is not None and recorder.shortfall:
        text += f". {recorder.shortfall.removesuffix('.')}"
    if run.error is not None and not isinstance(run.error, CartsError):
        raise run.error
    yield LiveEnded(text, recorded, None if run.error is None else str(run.error))


class _Follower(threading.Thread):
    """Thread that tracks a stream, and keeps its newest result.

    Attributes:
        statistics: throughput and latency.
        error: the error that ended the stream.
    """

    def __init__(
        self, stream: "OpenStream", tracker: "LiveTracker", results: "Results", recorder: "Recorder | None"
    ) -> None:
        super().__init__(name="carts-live-tracker", daemon=True)
        self.statistics = live.LiveStatistics()
        self.error: Exception | None = None
        self._stream, self._tracker, self._results, self._recorder = stream, tracker, results, recorder
        self._newest: Tracked | None = None
        self._over, self._changed = False, threading.Condition()
        self.start()

    def run(self) -> None:
        """Track until the stream ends."""
        sinks = [self._show] if self._recorder is None else [self._show, self._recorder]
        try:
            live.follow(self._stream.source, self._tracker, sinks, self.statistics)
        except Exception as error:  # It is reported at the end.
            self.error = error
        with self._changed:
            self._over = True
            self._changed.notify()

    @property
    def over(self) -> bool:
        """Whether the last result was taken."""
        with self._changed:
            return self._over and self._newest is None

    def take(self) -> "Tracked | None":
        """The newest result; None if there is none within `_WAIT`."""
        with self._changed:
            if self._newest is None and not self._over:
                self._changed.wait(_WAIT)
            newest, self._newest = self._newest, None
            return newest

    def _show(self, tracked: "Tracked") -> None:
        with self._changed:
            self._newest = tracked
            self._changed.notify()
        if self._stream.clients:
            message = self._results.message(tracked)
            for send in self._stream.clients:
                send(message)


def _result(scene: Scene, tracked: "Tracked") -> LiveResult:
    estimate, frame = tracked.estimate, tracked.stream_frame.frame
    frame = replace(frame, mounts=mounts_of(scene, frame, tracked.stream_frame.camera_poses))
    verdict, times = estimate.verdict.value, (tracked.age, tracked.interval)
    return LiveResult(frame, estimate.joint_positions, verdict, *times, tracked.current)
