"""Adapting the network to the recording: `carts train --for` in a process of its own, so that the page stays usable."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue

from carts_core.errors import CartsError
from carts_core.stopping import PARENT
from carts_viewer.job_work import Progress

OPTIONS: tuple[str, ...] = ()
"""Options of `carts train` besides the recording and the time."""
_POLL = 0.25
"""How often it is seen how training goes [s]."""
_LONGEST_END = 30.0
"""How long training that is stopped has for its checkpoint [s]."""


def adapt(sequence: Path, folder: Path, minutes: float) -> Generator[Progress]:
    """Train, and say each minute what is reached; whoever closes the iterator stops the training.

    Args:
        sequence: the sequence file.
        folder: of the run; one that was stopped goes on.
        minutes: time for training [min].

    Raises:
        CartsError: training failed.
    """
    training = _Training([str(folder), "--for", str(sequence), "--minutes", f"{minutes:g}", *OPTIONS])
    total, text, lines = max(1, round(minutes)), "Making images to measure with", []
    try:
        yield Progress(0, total, text, f"in {folder}")
        while training.running or training.said:
            line = training.next_line()
            if line is not None:
                lines.append(line)
                text = line
            yield Progress(min(training.minutes, total), total, text, line, _POLL)
    finally:
        training.end()
    if training.failed:
        raise CartsError(f"The network could not be adapted: {' '.join(lines[-3:]) or 'training ended early'}")
    kept = next((line for line in lines if line.startswith("kept, the best:")), lines[-1] if lines else "")
    refused = next((line for line in lines if line.startswith("not offered, since worse:")), None)
    yield Progress(total, total, refused or kept.partition(": ")[2] or kept)


class _Training:
    """A process that trains."""

    def __init__(self, arguments: list[str]) -> None:
        self._began = time.monotonic()
        # Waiting threads that spin would take the processor from the page.
        output = {"PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        environment = {**os.environ, **output, PARENT: str(os.getpid())}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "carts_core.cli", "train", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment,
        )
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._reader = threading.Thread(target=self._read, name="carts-training", daemon=True)
        self._reader.start()

    @property
    def running(self) -> bool:
        """Whether more may be said."""
        return self._reader.is_alive() or self._process.poll() is None

    @property
    def said(self) -> bool:
        """Whether there are lines that nobody has taken."""
        return not self._lines.empty()

    @property
    def failed(self) -> bool:
        """Whether it ended with an error."""
        return self._process.wait() != 0

    @property
    def minutes(self) -> int:
        """Since it began."""
        return int((time.monotonic() - self._began) / 60)

    def next_line(self) -> str | None:
        """What was said next; None where nothing is there yet."""
        with suppress(Empty):
            return self._lines.get_nowait()
        return None

    def end(self) -> None:
        """Have it keep what it has and end; nobody waits for that."""
        if self._process.poll() is None:
            self._process.terminate()
            threading.Thread(target=self._reap, daemon=True).start()

    def _reap(self) -> None:
        try:
            self._process.wait(_LONGEST_END)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                if line.strip():
                    self._lines.put(line.strip()[:500])
