"""How the viewer is asked to end: Ctrl-C, SIGTERM and SIGHUP all do the same, and none of them while it saves."""

import os
import signal
import threading
from types import FrameType
from typing import Any

_SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]


class EndRequest:
    """While entered, these signals end `wait`; until `ready` they do as before, or raise `KeyboardInterrupt`.

    After that they do nothing else, so what is being saved is saved. A signal that is ignored (`nohup`) stays so.
    """

    def __init__(self) -> None:
        self._former: dict[int, Any] = {}
        self._ready = False
        # A handler may run between any two instructions, where it must not wait for a lock; writing a byte it may.
        self._asked, self._ask = os.pipe()
        os.set_blocking(self._ask, False)

    def __enter__(self) -> "EndRequest":
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if number == signal.SIGTERM or signal.getsignal(number) is not signal.SIG_IGN:
                    self._former[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._former.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        os.close(self._asked)
        os.close(self._ask)

    def ready(self) -> None:
        """From now on a signal is no exception."""
        self._ready = True

    def wait(self) -> None:
        """Until one of the signals comes, or has come since `ready`."""
        os.read(self._asked, 1)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if not self._ready:
            former = self._former[number]
            if not callable(former):
                raise KeyboardInterrupt
            former(number, frame)
            return
        try:
            os.write(self._ask, b"x")
        except BlockingIOError:
            return  # It was asked often enough.
