"""Console output that escapes markup and control characters in untrusted text.

Names, paths and error messages may come from untrusted files. Square brackets are not interpreted as markup, and
characters that control the terminal or reverse the text direction are escaped.
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
"""Interval between progress lines written to a file or a pipe [s]."""
_KEPT = "\n\t"
_HIDDEN_CATEGORIES = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode categories of escaped characters: control, format and surrogate characters, line and paragraph separators."""
_MARKDOWN = re.compile(r"([\\`*{}\[\]#|!]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9]))")
"""Characters with a meaning in Markdown, except underscores inside a word."""


def visible(text: str) -> str:
    r"""Escape control characters other than newline and tab, for example ESC as `\x1b`."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode("ascii")
        if unicodedata.category(character) in _HIDDEN_CATEGORIES and character not in _KEPT
        else character
        for character in text
    )


def in_markdown(text: str) -> str:
    """Convert a string to one line of Markdown, escaped for Markdown and HTML."""
    return _MARKDOWN.sub(r"\\\1", visible(" ".join(text.split())).replace("&", "&amp;").replace("<", "&lt;"))


class Terminal(Console):
    """Console without markup, emoji codes and control characters."""

    def render_str(self, text: str, **options: Any) -> Text:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Convert a string to text without markup; overrides rich's method."""
        return super().render_str(visible(text), **{**options, "markup": False, "emoji": False})

    def print_error(self, error: BaseException) -> None:
        """Print an error for the user."""
        self.print(Text.assemble(("error:", "bold red"), f" {visible(str(error))}"), soft_wrap=True, highlight=False)


class PlainColumn(TextColumn):
    """Progress-bar column whose text is not parsed as markup."""

    def render(self, task: Task) -> Text:
        """Render the column's text for a task."""
        return Text(visible(self.text_format.format(task=task)), style="progress.description")


class Bar(Progress):
    """Progress bar on a `Terminal`."""

    def __init__(self, *columns: str | ProgressColumn, console: Console | None = None, **options: Any) -> None:
        super().__init__(*columns, console=console or Terminal(), **options)
        self._lines = None if self.console.is_terminal or self.disable else Terminal(stderr=True)
        self._printed = -math.inf

    def add_task(self, description: str, *args: Any, **fields: Any) -> TaskID:
        """Add a task as in rich; without a terminal, progress is printed as lines on standard error."""
        task = super().add_task(description, *args, **fields)
        self._printed = -math.inf
        self._print(task)
        return task

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Update a task as in rich; see `add_task`."""
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
        """Default columns: spinner, description, bar, percentage and remaining time."""
        time_left = TimeRemainingColumn()
        return SpinnerColumn(), PlainColumn("{task.description}"), BarColumn(), TaskProgressColumn(), time_left


def track(
    items: Iterable[T], description: str, *, console: Console, total: float | None = None, disable: bool = False
) -> Iterator[T]:
    """Yield the items and display a progress bar."""
    with Bar(console=console, disable=disable) as bar:
        yield from bar.track(items, total=total, description=description)


class VisibleFormatter(logging.Formatter):
    """Log formatter that escapes control characters."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a log record, escaped."""
        return visible(super().format(record))


def log_to_stderr(form: str = "%(levelname)s %(name)s: %(message)s") -> None:
    """Print warnings of all libraries to standard error, escaped."""
    handler = logging.StreamHandler()
    handler.setFormatter(VisibleFormatter(form))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
