"""Arrays that are kept for the next time, as many as fit into a number of bytes."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

import numpy as np


class ByteCache:
    """Least recently used arrays go first. Safe to use from several threads; what one makes, others wait for.

    Args:
        limit: memory [bytes]; a single array may be larger.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._used = 0
        self._arrays: OrderedDict[Hashable, np.ndarray] = OrderedDict()
        self._making: set[Hashable] = set()
        self._changed = threading.Condition()

    def get(self, key: Hashable, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array under `key`, made when it is not there.

        Raises:
            Exception: what `make` raises. Nothing is kept then, and whoever waited for it calls their own `make`.
        """
        with self._changed:
            self._changed.wait_for(lambda: key not in self._making)
            if key in self._arrays:
                self._arrays.move_to_end(key)
                return self._arrays[key]
            self._making.add(key)
        try:
            array = make()
            with self._changed:
                self._keep(key, array)
        finally:
            with self._changed:
                self._making.discard(key)
                self._changed.notify_all()
        return array

    def clear(self) -> None:
        """Keep none of them any longer."""
        with self._changed:
            self._arrays.clear()
            self._used = 0

    def __contains__(self, key: Hashable) -> bool:
        with self._changed:
            return key in self._arrays

    def _keep(self, key: Hashable, array: np.ndarray) -> None:
        self._arrays[key] = array
        self._used += array.nbytes
        while self._used > self._limit and len(self._arrays) > 1:
            self._used -= self._arrays.popitem(last=False)[1].nbytes
