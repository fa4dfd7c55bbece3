"""A page for each subcommand of `carts` with the output of `--help`."""

import contextlib
import io
import os

import tyro

from carts_core.cli import command_line as cli

WIDTH = 88
"""Columns of the help text."""


def subcommands() -> dict[str, type]:
    """Name of each subcommand -> its dataclass, in the order of `carts --help`."""
    return {name: cli.command_class(name) for name in cli.COMMANDS}


def help_text(*arguments: str) -> str:
    """Output of `carts ARGUMENTS --help`, without colours."""
    printed = io.StringIO()
    before = dict(os.environ)
    os.environ.update(COLUMNS=str(WIDTH), NO_COLOR="1")
    os.environ.pop("FORCE_COLOR", None)
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            tyro.cli(cli.any_command(), prog="carts", args=[*arguments, "--help"])  # pyright: ignore
    finally:
        os.environ.clear()
        os.environ.update(before)
    return "\n".join(line.rstrip() for line in printed.getvalue().splitlines())


def command_pages() -> dict[str, str]:
    """File name -> Markdown."""
    pages = {}
    for name, command in subcommands().items():
        summary = (command.__doc__ or "").strip()
        pages[f"command_{name}.md"] = f"# `carts {name}`\n\n{summary}\n\n```text\n{help_text(name)}\n```\n"
    return pages
