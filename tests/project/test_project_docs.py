"""The examples of docs/reference/project_file.md run."""

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "project_file.md"


def test_the_examples_of_the_page_run(
    tiny_sequence: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    folder = tiny_sequence().parent
    monkeypatch.chdir(folder)
    exec(program, {})
    assert "['Drag PSM1'] [0, 1, 2]" in capsys.readouterr().out
    queries = re.findall(r"```sql\n(.*?)```", text, re.DOTALL)
    with closing(sqlite3.connect(folder / "sequence.carts")) as connection:
        (joints,), (states,), (history,) = (connection.execute(query).fetchall() for query in queries)
    assert joints[:2] == (0, "PSM1") and joints[3] == "hand"
    assert states == ("accepted", 1)
    assert history[0] == 1 and history[2:] == ("Drag PSM1", 0)
