"""The lock that lets one writer in."""

import os
import socket
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from project_model import IDENTITY

from carts_core.project import Key, Project, Review
from carts_core.project.file import holder, try_lock

NOTE = {Key.review(0): Review(note="a")}


def test_one_at_a_time_and_the_next_when_the_first_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "project"
    path.touch()
    first, second = (os.open(path, os.O_RDWR) for _ in range(2))
    assert try_lock(first) and not try_lock(second)
    assert holder(path) == f"process {os.getpid()} on {socket.gethostname()}"
    os.close(first)
    assert try_lock(second)
    os.close(second)
    assert holder(path) == "another process"


def test_the_lock_outlives_another_descriptor_of_the_file_that_is_closed(project: Project, project_path: Path) -> None:
    project_path.read_bytes()
    with Project(IDENTITY, project_path) as second:
        assert not second.writable and "open for writing elsewhere" in (second.read_only_reason or "")
    program = (
        "import sys; from pathlib import Path; from project_model import IDENTITY;"
        "from carts_core.project import Project; print(Project(IDENTITY, Path(sys.argv[1])).writable)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [sys.executable, "-c", program, str(project_path)]
    finished = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, timeout=60)
    assert finished.stdout == "False\n"


def test_there_is_no_lock_file_whose_loss_would_let_two_writers_in(project: Project, project_path: Path) -> None:
    project.apply("Note", NOTE)
    assert {path.name for path in project_path.parent.iterdir()} == {"small.carts", "small.carts-wal"}


def test_other_programs_that_use_sqlite_cannot_write_meanwhile(project: Project, project_path: Path) -> None:
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        sqlite3.connect(project_path, timeout=0).execute("DELETE FROM steps")
    project.apply("Note", NOTE)
    project.close()
    with sqlite3.connect(project_path, timeout=0) as connection:
        assert connection.execute("SELECT count(*) FROM steps").fetchone() == (1,)
