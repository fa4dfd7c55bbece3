"""Edits a project until its disk is full, frees the disk, and checks that nothing was lost. Arguments: folder, how."""

import os
import resource
import sqlite3
import sys
from functools import partial
from pathlib import Path

from project_model import IDENTITY, visible

from carts_core.errors import ProjectError
from carts_core.project import Key, Project, Review

folder, how = Path(sys.argv[1]), sys.argv[2]
if how == "tmpfs":
    assert os.system(f"mount -t tmpfs -o size=1m none {folder}") == 0
path, filler = folder / "small.carts", folder / "filler"


def fill():
    if how == "limit":
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
    else:
        with filler.open("wb", buffering=0) as file:
            try:
                while file.write(b"x" * 4096):
                    pass
            except OSError:
                pass


def free():
    if how == "limit":
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    else:
        filler.unlink()


def edit(number):
    project.apply(f"edit {number}", {Key.review(number % 3): Review(note=f"{number} " + "long " * 1000)})


def refused(action):
    before = visible(project.state)
    try:
        action()
    except ProjectError as error:
        assert "This change was not saved" in str(error) and "Free disk space" in str(error), error
        assert visible(project.state) == before
        return True
    return False


project = Project(IDENTITY, path)
number = 0
while number < 19:
    edit(number)
    number += 1
edit(number)
fill()
while not refused(partial(edit, number + 1)):
    number += 1
assert refused(partial(edit, number + 1))
kept = visible(project.state)
assert kept["position"] == number + 1
with Project(IDENTITY, path, read_only=True) as reader:
    assert visible(reader.state) == kept
free()
edit(number + 1)
project.undo()
kept = visible(project.state)
project.close()
if how == "tmpfs":
    before = path.read_bytes()
    fill()
    try:
        Project(IDENTITY, path)
        raise SystemExit("opened for writing on a full disk")
    except ProjectError as error:
        assert "Free disk space" in str(error), error
    with Project(IDENTITY, path, read_only=True) as reader:
        assert visible(reader.state) == kept
    try:
        Project(IDENTITY, folder / "other.carts")
        raise SystemExit("began a project on a full disk")
    except ProjectError as error:
        assert "Free disk space" in str(error), error
    assert path.read_bytes() == before
    assert not list(folder.glob("other*")), os.listdir(folder)
    free()
with Project(IDENTITY, path) as project:
    assert visible(project.state) == kept
assert sqlite3.connect(path).execute("PRAGMA integrity_check").fetchone() == ("ok",)
print("kept", number)
