"""Cache of decoded images with a limit in bytes."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from operator import attrgetter
from typing import Any, Generic, TypeVar

T = TypeVar("T")


class ByteCache(Generic[T]):
    """Least-recently-used cache with a limit in bytes; thread-safe, and each value is computed only once.

    Args:
        limit: memory [bytes]; a single value may be larger.
        size: memory of a value [bytes]; by default values are arrays.
    """

    def __init__(self, limit: int, size: Callable[[Any], int] = attrgetter("nbytes")) -> None:
        self._limit, self._size = limit, size
        self._used = 0
        self._values: OrderedDict[Hashable, T] = OrderedDict()
        self._making: set[Hashable] = set()
        self._changed = threading.Condition()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The value of `key`, computed by `make` if it is not cached.

        Raises:
            Exception: what `make` raises. Nothing is cached then, and waiting threads call their own `make`.
        """
        with self._changed:
            self._changed.wait_for(lambda: key not in self._making)
            if (found := self.find(key)) is not None:
                return found
            self._making.add(key)
        try:
            value = make()
            self.add(key, value)
        finally:
            with self._changed:
                self._making.discard(key)
                self._changed.notify_all()
        return value

    def find(self, key: Hashable) -> T | None:
        """The cached value of `key`; None if it is not cached."""
        with self._changed:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def add(self, key: Hashable, value: T) -> None:
        """Cache a value; the least recently used ones are dropped beyond the limit."""
        with self._changed:
            if key in self._values:
                self._used -= self._size(self._values.pop(key))
            self._values[key] = value
            self._used += self._size(value)
            while self._used > self._limit and len(self._values) > 1:
                self._used -= self._size(self._values.popitem(last=False)[1])

    def clear(self) -> None:
        """Remove all values."""
        with self._changed:
            self._values.clear()
            self._used = 0

    def __contains__(self, key: Hashable) -> bool:
        with self._changed:
            return key in self._values
