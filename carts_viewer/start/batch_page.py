"""Page of a batch: table of jobs, failures first, and the worst frames."""

import heapq
import threading
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from carts_core.batch.cost import Cost
from carts_core.batch.folder import (
    ORDER,
    FrameFinding,
    KnownJob,
    known_jobs,
    most_urgent_first,
    read_jobs,
)
from carts_core.batch.results import review_project, sequence_file
from carts_core.errors import CartsError, SettingsError
from carts_core.files import output_path
from carts_core.files.reading import IMAGE, read_bytes
from carts_core.package_imports import gc_paused
from carts_core.recording import Sequence
from carts_viewer.start.host import Host, SitePage
from carts_viewer.transport.document import render

_UPDATE_INTERVAL, _IDLE_INTERVAL = 5.0, 15.0
"""Interval between updates while jobs run, and while none runs [s]."""
_MAX_WORST = 12
"""Maximum number of shown frames."""
_ROWS = 100
"""Number of jobs on a page of the list."""
_STEP = {"previous": -1, "next": 1}
_MAX_WANTED = 200
"""Maximum length of a searched name [characters]."""
_SEPARATOR = "\n"
"""Separator of job and frame in the value of a button; names do not contain it."""


class BatchPage(SitePage):
    """Table of jobs and pictures of the worst frames, which can be opened for review."""

    def __init__(self, site: Host, folder: Path) -> None:
        """
        Raises:
            SettingsError: the folder is not a batch.
        """
        self._site = site
        self._batch = output_path(folder)
        self._jobs = read_jobs(folder)
        self._problem = ""
        self._known: list[KnownJob] = []
        self._shown, self._wanted, self._page = "", "", 0
        self._addresses: dict[tuple[object, ...], str] = {}
        """Addresses of the shown pictures, by job, file and times of the job's files."""
        self._waits = False
        self._closed = threading.Event()

    def show(self) -> None:
        """Update the document, and repeat the update while a tab is open."""
        self._known = known_jobs(self._batch, self._jobs, self._known)
        with gc_paused():
            self._render()
        running = any(entry.status == "running" for entry in self._known)
        self._update(_UPDATE_INTERVAL if running else _IDLE_INTERVAL)

    def _render(self) -> None:
        """Show the known jobs; the document is sent only if it has changed."""
        known, cost = most_urgent_first(self._known), Cost.of(self._known)
        listed = [entry for entry in known if self._wanted.casefold() in entry.job.name.casefold()]
        self._page = max(0, min(self._page, (len(listed) - 1) // _ROWS))
        counts, first = Counter(entry.status for entry in known), self._page * _ROWS
        content = render(
            "batch.html",
            name=self._batch.path.name,
            summary=", ".join(f"{counts[status]} {status}" for status in ORDER if counts[status]),
            cost=cost.summary(counts["running"]),
            forecast=cost.forecast(),
            problem=self._problem,
            wanted=self._wanted,
            rows=listed[first : first + _ROWS],
            first=first,
            listed=len(listed),
            worst=self._worst(known),
            separator=_SEPARATOR,
        )
        if content != self._shown:
            self._shown = content
            self._site.document.show(content)

    def choose(self, name: str, value: str) -> None:
        """Carry out a choice of the user."""
        self._problem = ""
        match name:
            case "back":
                return self._site.show_start()
            case "review":
                job, _, frame = value.partition(_SEPARATOR)
                return self._review(job, frame)
            case "find" | "previous" | "next":
                self._wanted, self._page = (
                    (value[:_MAX_WANTED], 0) if name == "find" else (self._wanted, self._page + _STEP[name])
                )
                return self._render()
        self.show()

    def fail(self, error: Exception) -> None:
        """Show an error."""
        self._problem = str(error) or type(error).__name__
        self.show()

    def close(self) -> None:
        """Stop updating."""
        self._closed.set()

    def _review(self, name: str, frame_id: str) -> None:
        """Open a job's recording with its results.

        Raises:
            CartsError: the job is unknown, lies outside of the allowed folders, or has no results.
        """
        job = next((job for job in self._jobs if job.name == name), None)
        if job is None:
            raise SettingsError(f"This batch has no job {name!r}.")
        folder = self._batch / "jobs" / job.name
        path = self._site.roots.checked(sequence_file(folder, job))
        if not folder.path.is_dir():
            raise CartsError(f"{name} has not started yet, so it has no results.")
        project = review_project(folder, job)
        frames = list(Sequence.open(path).frame_ids) if frame_id else []
        self._site.open_sequence(path, project=project, frame=frames.index(frame_id) if frame_id in frames else None)

    def _worst(self, known: list[KnownJob]) -> list[tuple[float, KnownJob, FrameFinding, str]]:
        """Probability, job, frame and URL of the picture of the frames with the highest probability of failure."""
        found = [
            (frame.probability, entry, frame)
            for entry in known
            for frame in (entry.results.pictured if entry.results else ())
        ]
        worst = heapq.nlargest(_MAX_WORST, found, key=lambda each: each[0])
        keys = [(entry.job.name, frame.picture, entry.written) for _, entry, frame in worst]
        self._addresses = {
            key: self._addresses.get(key) or self._published(entry, frame.picture)
            for key, (_, entry, frame) in zip(keys, worst, strict=True)
        }
        return [(*each, self._addresses[key]) for key, each in zip(keys, worst, strict=True)]

    def _published(self, entry: KnownJob, name: str) -> str:
        """URL of a job's picture; empty if the picture cannot be read."""
        try:
            path = (self._batch / "jobs" / entry.job.name / name).path
            image = cv2.imdecode(np.frombuffer(read_bytes(path, IMAGE), np.uint8), cv2.IMREAD_COLOR)
        except (OSError, CartsError, cv2.error):
            return ""
        return "" if image is None else self._site.page.media.publish(cv2.imencode(".jpg", image)[1].tobytes())

    def _update(self, interval: float) -> None:
        """Update the page after an interval [s], once for any number of calls until then."""

        def update() -> None:
            self._waits = False
            if not self._closed.is_set() and self._site.page.server.get_clients():
                self.show()

        def wait() -> None:
            if not self._closed.wait(interval):
                self._site.post(update)

        if not self._waits:
            self._waits = True
            threading.Thread(target=wait, name="carts-batch-page", daemon=True).start()
