"""A batch of `carts batch`: its jobs, failures first, its worst frames, and a way into any of them."""

import threading
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from carts_core.batch.folder import ORDER, KnownJob, known_jobs, most_urgent_first, read_jobs
from carts_core.batch.review import review_project, sequence_file
from carts_core.errors import CartsError, SettingsError
from carts_core.files import output_path
from carts_core.files.reading import IMAGE, read_bytes
from carts_core.recording import Sequence
from carts_viewer.start.host import Host
from carts_viewer.transport.document import alert, button, escaped

_SECONDS = 5.0
"""Interval between updates while jobs run [s]."""
_WORST = 12
_SHOWN = 500
"""Jobs that are listed."""
_VERDICTS = ("good", "doubtful", "failed")
_SEPARATOR = "\n"
"""Between a job and a frame in what a button says; neither has one in its name."""


class BatchPage:
    """A table of jobs and pictures of the worst frames; each opens for review."""

    def __init__(self, site: Host, folder: Path) -> None:
        """
        Raises:
            SettingsError: the folder is no batch.
        """
        self._site = site
        self._batch = output_path(folder)
        self._jobs = read_jobs(folder)
        self._problem = ""
        self._closed = threading.Event()

    def show(self) -> None:
        """Bring the document up to date, now and as long as jobs run."""
        known = most_urgent_first(known_jobs(self._batch, self._jobs))
        counts = Counter(entry.status for entry in known)
        summary = ", ".join(f"{counts[status]} {status}" for status in ORDER if counts[status])
        problem = alert(self._problem)
        more = f"<p>{len(known) - _SHOWN} more are not listed.</p>" if len(known) > _SHOWN else ""
        rows = "".join(map(_row, known[:_SHOWN]))
        self._site.document.show(
            f"<h1>Batch {escaped(self._batch.path.name)}</h1><p>{escaped(summary)}</p>"
            f'<div class="bar">{button("back", "All recordings")}{button("refresh", "Look again")}</div>{problem}'
            f'<h2>Jobs</h2><div class="jobs" data-scroll="jobs"><table><thead><tr><th>Job</th><th>Status</th>'
            f"<th>Good</th><th>Doubtful</th><th>Failed</th><th></th></tr></thead><tbody>{rows}</tbody></table></div>"
            f"{more}{self._worst(known)}"
        )
        if counts["running"]:
            self._look_again()

    def choose(self, name: str, value: str) -> None:
        """Carry out a choice."""
        self._problem = ""
        match name:
            case "back":
                return self._site.show_start()
            case "review":
                job, _, frame = value.partition(_SEPARATOR)
                return self._review(job, frame)
        self.show()

    def click(self, u: float, v: float) -> None:
        """There is no image here."""

    def fail(self, error: Exception) -> None:
        """Show what went wrong."""
        self._problem = str(error) or type(error).__name__
        self.show()

    def close(self) -> None:
        """Look no more."""
        self._closed.set()

    def _review(self, name: str, frame_id: str) -> None:
        """Open a job's recording with its results.

        Raises:
            CartsError: there is no such job, or it lies outside of the allowed folders, or has no results.
        """
        job = next((job for job in self._jobs if job.name == name), None)
        if job is None:
            raise SettingsError(f"This batch has no job {name!r}.")
        folder = self._batch / "jobs" / job.name
        path = self._site.roots.checked(sequence_file(folder, job))
        if not folder.path.is_dir():
            raise CartsError(f"{name} was not begun yet, so there is nothing to look at.")
        project = review_project(folder, job)
        frames = list(Sequence.open(path).frame_ids) if frame_id else []
        self._site.open_sequence(path, project=project, frame=frames.index(frame_id) if frame_id in frames else None)

    def _worst(self, known: list[KnownJob]) -> str:
        found = [
            (frame.probability, entry, frame)
            for entry in known
            for frame in (entry.findings.frames if entry.findings else ())
            if frame.picture
        ]
        cards = []
        for probability, entry, frame in sorted(found, key=lambda each: -each[0])[:_WORST]:
            address = self._published(entry, frame.picture)
            open_it = button("review", "Open", f"{entry.job.name}{_SEPARATOR}{frame.frame}", kind="main")
            picture = f'<img src="{address}" alt="">' if address else '<div class="blank"></div>'
            cards.append(
                f'<div class="card">{picture}<div><b>{escaped(frame.verdict)}: {escaped(entry.job.name)}</b>'
                f'<small title="{escaped(frame.reason)}">frame {escaped(frame.frame)}, {escaped(frame.camera)}, wrong '
                f'with a probability of {probability:.2f}</small><div class="bar">{open_it}</div></div></div>'
            )
        return f'<h2>Worst frames</h2><div class="cards">{"".join(cards)}</div>' if cards else ""

    def _published(self, entry: KnownJob, name: str) -> str:
        """The address of a picture of a job; empty where it cannot be read."""
        try:
            path = (self._batch / "jobs" / entry.job.name / name).path
            image = cv2.imdecode(np.frombuffer(read_bytes(path, IMAGE), np.uint8), cv2.IMREAD_COLOR)
        except (OSError, CartsError, cv2.error):
            return ""
        return "" if image is None else self._site.page.media.publish(cv2.imencode(".jpg", image)[1].tobytes())

    def _look_again(self) -> None:
        def wait() -> None:
            if not self._closed.wait(_SECONDS):
                self._site.post(lambda: None if self._closed.is_set() else self.show())

        threading.Thread(target=wait, name="carts-batch-page", daemon=True).start()


def _row(entry: KnownJob) -> str:
    frames = entry.findings.frames if entry.findings else ()
    counts = Counter(frame.verdict for frame in frames)
    numbers = "".join(
        f'<td data-label="{verdict.capitalize()}">{counts[verdict] if frames else "–"}</td>' for verdict in _VERDICTS
    )
    error = f"<br><small>{escaped(entry.error)}</small>" if entry.error else ""
    open_it = button("review", "Open", entry.job.name) if entry.findings else ""
    status = escaped(entry.status)
    return (
        f"<tr><td>{escaped(entry.job.name)}<br><small>{escaped(entry.job.recording)}</small></td>"
        f'<td><span class="status {status}">{status}</span>{error}</td>{numbers}<td>{open_it}</td></tr>'
    )
