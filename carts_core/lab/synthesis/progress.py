"""A progress bar for the terminal."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, MofNCompleteColumn, TimeRemainingColumn

from ...console import Bar, PlainColumn, Terminal
from .synthesize import Progress


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """Something to give to `synthesize` as `progress`; the bar is drawn on standard error while the block runs."""
    columns = (PlainColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(*columns, console=Terminal(stderr=True)) as bar:
        task = bar.add_task("starting", total=None)

        def report(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        yield report
