"""How far an export is, and whether it should stop."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from ..errors import CartsError

T = TypeVar("T")


class ExportCancelled(CartsError):
    """The export was stopped on request; nothing of it is left."""


@dataclass(frozen=True)
class Monitor:
    """What an export reports to and asks, between two of its steps."""

    progress: Callable[[int, int], None] | None = None
    """Called with the number of steps done and of all."""
    cancelled: Callable[[], bool] | None = None
    """Asked before every step, for example `threading.Event().is_set`."""

    def track(self, steps: Sequence[T]) -> Iterator[T]:
        """The steps one by one, reported when they are done.

        Raises:
            ExportCancelled: `cancelled` said so.
        """
        for done, step in enumerate(steps):
            self._check()
            yield step
            if self.progress is not None:
                self.progress(done + 1, len(steps))
        self._check()

    def _check(self) -> None:
        if self.cancelled is not None and self.cancelled():
            raise ExportCancelled("the export was cancelled. Nothing was written.")
