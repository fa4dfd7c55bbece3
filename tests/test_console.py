"""Printing of untrusted text, and words of messages."""

import io
import logging

import pytest
from rich.table import Table

from carts_core.console import Bar, Terminal, VisibleFormatter, in_markdown, track, visible
from carts_core.wording import closest, counted

HOSTILE = "[[cameras]] 'left' [red]x[/red] :smile: [/] \x1b[2J\x9b31m\u202eabc\u2066 \r\a"
SHOWN = "[[cameras]] 'left' [red]x[/red] :smile: [/] \\x1b[2J\\x9b31m\\u202eabc\\u2066 \\r\\x07"


def printed(*, terminal: bool) -> tuple[Terminal, io.StringIO]:
    text = io.StringIO()
    return Terminal(file=text, force_terminal=terminal, width=400, color_system=None), text


@pytest.mark.parametrize("terminal", [True, False])
def test_brackets_and_control_characters_are_printed_as_they_are_written(terminal: bool):
    console, text = printed(terminal=terminal)
    console.print(HOSTILE)
    console.print_error(ValueError(HOSTILE))
    assert text.getvalue().count(SHOWN) == 2


def test_tables_take_titles_headers_and_cells_for_text():
    console, text = printed(terminal=False)
    table = Table(title=HOSTILE, caption=HOSTILE)
    table.add_column(HOSTILE)
    table.add_row(HOSTILE)
    console.print(table)
    assert text.getvalue().count(SHOWN) == 4


def test_progress_bars_take_descriptions_for_text():
    console, text = printed(terminal=True)
    assert list(track([1, 2], HOSTILE, console=console)) == [1, 2]
    with Bar(console=console) as bar:
        bar.add_task(HOSTILE, total=1)
    assert SHOWN in text.getvalue() and "\x1b[2J" not in text.getvalue()


def test_log_lines_are_visible():
    record = logging.LogRecord("x", logging.WARNING, "", 0, "refused: %s", (HOSTILE,), None)
    assert SHOWN in VisibleFormatter("%(message)s").format(record)


def test_names_that_people_write_stay_as_they_are():
    for name in ("Größe 3", "左", "naïve/путь", "a\nb", "tab\there"):
        assert visible(name) == name


def test_lone_surrogates_can_be_printed():
    assert visible("\ud800") == "\\ud800"


def test_markdown_leaves_names_with_underscores_as_they_are():
    assert in_markdown("T_world_base of PSM1_a") == "T_world_base of PSM1_a"
    assert in_markdown("_a_ __b__") == r"\_a\_ \_\_b\_\_"


def test_markdown_has_no_markup_of_others():
    assert in_markdown("<script>| *a* [b](c) `d` \n # e") == "&lt;script>\\| \\*a\\* \\[b\\](c) \\`d\\` \\# e"


def test_one_thing_is_not_called_by_its_plural() -> None:
    assert [counted(number, "frame") for number in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]


@pytest.mark.parametrize(
    ("name", "meant"),
    [("psm1", "PSM1"), ("lef", "left"), ("7", "007"), ("0007", "007"), ("0", None), ("zebra", None), ("", None)],
)
def test_the_name_that_is_meant_is_suggested(name: str, meant: str | None) -> None:
    assert closest(name, ["PSM1", "left", "007", "070"]) == ("" if meant is None else f" Did you mean {meant!r}?")
