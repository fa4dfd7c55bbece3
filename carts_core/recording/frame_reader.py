"""Frames for somebody who goes from one to the next: those ahead are decoded before they are asked for."""

import threading
from collections import deque
from collections.abc import Collection, Iterable

from .sequence import CACHE_BYTES, Frame, Sequence

AHEAD = 8
"""At most this many frames are read in advance."""
LONGEST_STRIDE = 10
"""Going further than this many frames at once is a jump, which says nothing about the next one."""


class FrameReader:
    """Reads frames, and on a thread of its own the neighbours in the direction of travel into the sequence's cache.

    Asking for another frame makes what was planned void. An error in a frame that nobody has asked for yet is dropped;
    who asks for it reads it again and gets the error. The thread lives while there is something to read.
    """

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self._lock = threading.Lock()
        self._plan: deque[tuple[int, str, tuple[str, ...]]] = deque()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._last: int | None = None
        self._stride = 1

    def frame(self, index: int, domain: str, *cameras: str) -> Frame:
        """One frame with the images of some cameras.

        Raises:
            SequenceError: there is no such frame, domain or camera, or the image is not usable.
        """
        self._replace_plan(())
        frame = self._sequence.frame(index, domain, list(cameras))
        moved = 0 if self._last is None else index - self._last
        self._last = index
        if moved:
            self._stride = moved if abs(moved) <= LONGEST_STRIDE else 1
        self._replace_plan((row, domain, cameras) for row in self._neighbours(index, cameras))
        return frame

    def close(self) -> None:
        """Stop reading in advance and wait for the thread; `frame` still works."""
        with self._lock:
            self._closed = True
            self._plan.clear()
            thread = self._thread
        if thread is not None:
            thread.join()

    def _neighbours(self, index: int, cameras: Collection[str]) -> list[int]:
        """Numbers of the frames that will probably be asked for next, the likeliest first."""
        sizes = [own.width * own.height for own in self._sequence.scene.cameras if own.name in cameras]
        # An image, a mask; and no more than half of the cache, or they would push out what was seen last.
        ahead = min(AHEAD, CACHE_BYTES // 2 // max(4 * sum(sizes), 1))
        rows = [index + self._stride * count for count in range(1, ahead + 1)] + [index - self._stride]
        return [row for row in rows if 0 <= row < len(self._sequence)]

    def _replace_plan(self, plan: Iterable[tuple[int, str, tuple[str, ...]]]) -> None:
        with self._lock:
            self._plan = deque(() if self._closed else plan)
            if self._plan and self._thread is None:
                self._thread = threading.Thread(target=self._read, name="carts-frames", daemon=True)
                self._thread.start()

    def _read(self) -> None:
        while True:
            with self._lock:
                if not self._plan:
                    self._thread = None
                    return
                index, domain, cameras = self._plan.popleft()
            try:
                self._sequence.frame(index, domain, list(cameras))
            except Exception:  # Whoever asks for this frame meets the same.
                continue
