"""The examples of docs/reference/project_file.md run."""

import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "project_file.md"


def test_the_examples_of_the_page_run(tiny_sequence: Callable[..., Path]) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    folder = tiny_sequence().parent
    finished = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, capture_output=True, text=True, check=False, timeout=120
    )
    assert finished.returncode == 0, finished.stderr
    assert "['Drag PSM1'] [0, 1, 2]" in finished.stdout
    queries = re.findall(r"```sql\n(.*?)```", text, re.DOTALL)
    with closing(sqlite3.connect(folder / "sequence.carts")) as connection:
        (joints,), (states,), (history,) = (connection.execute(query).fetchall() for query in queries)
    assert joints[:2] == (0, "PSM1") and joints[3] == "hand"
    assert states == ("accepted", 1)
    assert history[0] == 1 and history[2:] == ("Drag PSM1", 0)
