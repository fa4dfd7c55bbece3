"""What a command printed, and why it refused."""

import re
from collections.abc import Callable

import pytest

from carts_core.cli.command_line import BAD_INPUT, main


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[[], str]:
    """Function that returns the standard output since the last call, in one line."""
    return lambda: " ".join(capsys.readouterr().out.split())


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that must end with the status of bad input; returns its message, in one line."""

    def run(*arguments: object) -> str:
        with pytest.raises(SystemExit) as stop:
            main(list(map(str, arguments)))
        assert stop.value.code == BAD_INPUT
        return re.sub(r"[\s│]+", " ", capsys.readouterr().err)

    return run
