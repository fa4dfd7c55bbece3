"""Page of a batch: table of jobs, failures first, and the worst frames."""

import threading
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from carts_core.batch.folder import (
    ORDER,
    FrameFinding,
    KnownJob,
    known_jobs,
    most_urgent_first,
    read_jobs,
    review_project,
    sequence_file,
)
from carts_core.errors import CartsError, SettingsError
from carts_core.files import output_path
from carts_core.files.reading import IMAGE, read_bytes
from carts_core.recording import Sequence
from carts_viewer.start.host import Host
from carts_viewer.transport.document import render

_UPDATE_INTERVAL = 5.0
"""Interval between updates while jobs run [s]."""
_MAX_WORST = 12
"""Maximum number of shown frames."""
_MAX_LISTED = 500
"""Maximum number of listed jobs."""
_SEPARATOR = "\n"
"""Separator of job and frame in the value of a button; names do not contain it."""


class BatchPage:
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
        self._closed = threading.Event()

    def show(self) -> None:
        """Update the document, and repeat the update while jobs run."""
        self._known = known = most_urgent_first(known_jobs(self._batch, self._jobs, self._known))
        counts = Counter(entry.status for entry in known)
        content = render(
            "batch.html",
            name=self._batch.path.name,
            summary=", ".join(f"{counts[status]} {status}" for status in ORDER if counts[status]),
            problem=self._problem,
            known=known,
            most=_MAX_LISTED,
            worst=self._worst(known),
            separator=_SEPARATOR,
        )
        self._site.document.show(content)
        if counts["running"]:
            self._update()

    def choose(self, name: str, value: str) -> None:
        """Carry out a choice of the user."""
        self._problem = ""
        match name:
            case "back":
                return self._site.show_start()
            case "review":
                job, _, frame = value.partition(_SEPARATOR)
                return self._review(job, frame)
        self.show()

    def click(self, u: float, v: float) -> None:
        """Do nothing, since no image is shown."""

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
            for frame in (entry.findings.frames if entry.findings else ())
            if frame.picture
        ]
        worst = sorted(found, key=lambda each: -each[0])[:_MAX_WORST]
        return [(each, entry, frame, self._published(entry, frame.picture)) for each, entry, frame in worst]

    def _published(self, entry: KnownJob, name: str) -> str:
        """URL of a job's picture; empty if the picture cannot be read."""
        try:
            path = (self._batch / "jobs" / entry.job.name / name).path
            image = cv2.imdecode(np.frombuffer(read_bytes(path, IMAGE), np.uint8), cv2.IMREAD_COLOR)
        except (OSError, CartsError, cv2.error):
            return ""
        return "" if image is None else self._site.page.media.publish(cv2.imencode(".jpg", image)[1].tobytes())

    def _update(self) -> None:
        def wait() -> None:
            if not self._closed.wait(_UPDATE_INTERVAL):
                self._site.post(lambda: None if self._closed.is_set() else self.show())

        threading.Thread(target=wait, name="carts-batch-page", daemon=True).start()
