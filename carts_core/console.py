"""What is printed: text of others in full and harmless, wherever it appears.

Names, paths and errors come from files of others. Square brackets in them are no markup, and characters that would
steer a terminal, or turn the order of what follows, are shown as escapes.
"""

import logging
import math
import re
import time
import unicodedata
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TaskID,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

T = TypeVar("T")

_BETWEEN_LINES = 10.0
"""Time between lines of progress in a file or a pipe [s]."""
_KEPT = "\n\t"
_HIDDEN_CATEGORIES = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Control, format and surrogate characters, and separators of lines and paragraphs."""
_MARKDOWN = re.compile(r"([\\`*{}\[\]#|!]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9]))")
"""What Markdown takes for its own; an underscore inside a word it leaves alone."""


def visible(text: str) -> str:
    r"""`text` with every character that a terminal or a page obeys instead of showing as an escape, say `\x1b`."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode("ascii")
        if unicodedata.category(character) in _HIDDEN_CATEGORIES and character not in _KEPT
        else character
        for character in text
    )


def in_markdown(text: str) -> str:
    """`text` for a page in Markdown: in one line, with nothing in it that Markdown or HTML takes for its own."""
    return _MARKDOWN.sub(r"\\\1", visible(" ".join(text.split())).replace("&", "&amp;").replace("<", "&lt;"))


class Terminal(Console):
    """A console that takes text for text: no markup, no emoji codes, no control characters."""

    def render_str(self, text: str, **options: Any) -> Text:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As in rich, for every string: printed, in a table, or in its title."""
        return super().render_str(visible(text), **{**options, "markup": False, "emoji": False})

    def print_error(self, error: BaseException) -> None:
        """An error that is meant for people."""
        self.print(Text.assemble(("error:", "bold red"), f" {visible(str(error))}"), soft_wrap=True, highlight=False)


class PlainColumn(TextColumn):
    """A column of a progress bar whose text is no markup."""

    def render(self, task: Task) -> Text:
        """The text of a task."""
        return Text(visible(self.text_format.format(task=task)), style="progress.description")


class Bar(Progress):
    """A progress bar on a `Terminal`."""

    def __init__(self, *columns: str | ProgressColumn, console: Console | None = None, **options: Any) -> None:
        super().__init__(*columns, console=console or Terminal(), **options)
        self._lines = None if self.console.is_terminal or self.disable else Terminal(stderr=True)
        self._printed = -math.inf

    def add_task(self, description: str, *args: Any, **fields: Any) -> TaskID:
        """As in rich; in a file or a pipe, progress is lines on the standard error, the first one at once."""
        task = super().add_task(description, *args, **fields)
        self._printed = -math.inf
        self._print(task)
        return task

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """As in rich; see `add_task`."""
        super().update(task_id, **changes)
        self._print(task_id)

    def _print(self, task_id: TaskID) -> None:
        if self._lines is None or time.monotonic() < self._printed + _BETWEEN_LINES:
            return
        self._printed, task = time.monotonic(), self._tasks[task_id]
        done = "" if task.total is None else f": {task.completed:g} of {task.total:g}"
        self._lines.print(f"{task.description}{done}", soft_wrap=True)

    @classmethod
    def get_default_columns(cls) -> tuple[ProgressColumn, ...]:
        """A sign of life, description, bar, share and time."""
        time_left = TimeRemainingColumn()
        return SpinnerColumn(), PlainColumn("{task.description}"), BarColumn(), TaskProgressColumn(), time_left


def track(
    items: Iterable[T], description: str, *, console: Console, total: float | None = None, disable: bool = False
) -> Iterator[T]:
    """The items, with a progress bar while they are used."""
    with Bar(console=console, disable=disable) as bar:
        yield from bar.track(items, total=total, description=description)


class VisibleFormatter(logging.Formatter):
    """Log lines with what is foreign in them made visible."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        return visible(super().format(record))


def log_to_stderr(form: str = "%(levelname)s %(name)s: %(message)s") -> None:
    """Warnings and worse of every library go to standard error, made visible."""
    handler = logging.StreamHandler()
    handler.setFormatter(VisibleFormatter(form))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
