"""One live stream, followed on a thread of its own; the worker takes the newest result whenever it has time."""

import threading

from carts_core.live import LiveStatistics, LiveTracker, OpenStream, Recorder, Results, Tracked, follow


class LiveRun:
    """A stream that is being followed.

    Args:
        stream: where frames come from, and results go besides.
        tracker: of the arms.
        results: makes messages for the stream's clients.
        recorder: keeps what is seen; None: nothing does.

    Attributes:
        statistics: how it goes.
        error: what ended it; None if it goes on, or ended by itself.
    """

    def __init__(self, stream: OpenStream, tracker: LiveTracker, results: Results, recorder: Recorder | None) -> None:
        self.statistics = LiveStatistics()
        self.error: Exception | None = None
        self.recorder = recorder
        self._stream, self._tracker, self._results = stream, tracker, results
        self._newest: Tracked | None = None
        self._changing = threading.Lock()
        self._thread = threading.Thread(target=self._follow, name="carts-live-tracker", daemon=True)
        self._thread.start()

    @property
    def over(self) -> bool:
        """Whether no more results come."""
        return not self._thread.is_alive()

    @property
    def port(self) -> int | None:
        """Where joints, or frames, may be sent to; None where nothing may be."""
        return None if self._stream.server is None else self._stream.server.port

    def take(self) -> Tracked | None:
        """The newest result that was not taken yet."""
        with self._changing:
            newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        """End it, and wait for its thread; what was recorded is not finished by this."""
        self._stream.close()
        self._thread.join(10.0)

    def _follow(self) -> None:
        sinks = [self._show, *([self.recorder] if self.recorder is not None else [])]
        try:
            follow(self._stream.source, self._tracker, sinks, self.statistics)
        except Exception as error:  # The worker shows it.
            self.error = error
        finally:
            self._stream.close()
            self._tracker.close()

    def _show(self, tracked: Tracked) -> None:
        with self._changing:
            self._newest = tracked
        if self._stream.clients:
            message = self._results.message(tracked)
            for send in self._stream.clients:
                send(message)
