"""Other processes that use a project, forked from one that has imported what they need."""

import itertools
import multiprocessing
import time
from multiprocessing.connection import Connection
from pathlib import Path

from project_model import IDENTITY, act

from carts_core.project import Project

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["carts_core.project"])


def hold(path: Path, writable: Connection) -> None:
    """Open a project, send whether it can be written to, and keep it open."""
    project = Project(IDENTITY, path)
    writable.send(project.writable)
    time.sleep(600)


def edit_until_killed(path: Path, seed: int, acknowledged: Connection) -> None:
    """Send the number of each edit once it was made."""
    project = Project(IDENTITY, path)
    assert project.writable
    acknowledged.send("ready")
    for number in itertools.count():
        act(seed, number, project)
        acknowledged.send(number)
