"""The project or its log is deleted, moved, replaced or cut while edits go on: every acknowledged edit can be had."""

import os
import random
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from project_model import IDENTITY

from carts_core.errors import ProjectError
from carts_core.project import Key, Project, Review, store

WAYS: dict[str, Callable[[Path], object]] = {
    "deleted": lambda path: path.unlink(),
    "emptied": lambda path: os.truncate(path, 0),
    "cut in the middle": lambda path: os.truncate(path, path.stat().st_size // 2),
    "moved": lambda path: path.rename(path.with_name("elsewhere")),
    "replaced by a copy": lambda path: _replace(path, path.read_bytes()),
    "replaced by something else": lambda path: _replace(path, b"something else"),
    "overwritten": lambda path: path.write_bytes(b"something else" * 1000),
    "replaced by a link": lambda path: (path.rename(path.with_name("elsewhere")), path.symlink_to("elsewhere")),
}


def _replace(path: Path, content: bytes) -> None:
    other = path.with_name("other")
    other.write_bytes(content)
    other.replace(path)


def _lose(folder: Path, way: str, suffix: str, seed: int) -> None:
    """Edit a project in which something happens at a random moment, and look for every acknowledged edit."""
    dice, path = random.Random(seed), folder / "small.carts"
    project = Project(IDENTITY, path)
    target = folder / f"small.carts{suffix}"
    happened = threading.Event()

    def happen() -> None:
        WAYS[way](target)
        happened.set()

    timer = threading.Timer(0.002 + 0.08 * dice.random(), happen)
    timer.start()
    acknowledged, after = [], 0
    while after < 3:
        note = f"note {len(acknowledged)}"
        project.apply(note, {Key.review(0): Review(note=note)})
        acknowledged.append(note)
        assert project.safe
        after += happened.is_set()
    timer.join()
    project.check()
    assert project.storage_failure is not None and way, f"{way} {suffix} was not noticed"
    assert project.path != path and "rescued" in project.path.name and str(project.path) in project.storage_failure
    # As after a kill: what was acknowledged must be in the file by now.
    copy = folder / "copy"
    copy.mkdir()
    for file in folder.glob(f"{project.path.name}*"):
        shutil.copy(file, copy)
    for closed in (False, True):
        place = project.path if closed else copy / project.path.name
        if closed:
            project.close()
        with Project(IDENTITY, place) as again:
            assert again.writable and [step.name for step in again.history()] == acknowledged
            for number in range(len(acknowledged), 0, -1):
                assert again.state.review(0).note == acknowledged[number - 1]
                again.undo()


CASES = [(way, suffix) for way in WAYS for suffix in ("", "-wal")]


@pytest.mark.parametrize(("way", "suffix"), CASES)
def test_edits_are_rescued_when_a_file_is_lost_while_it_is_open(tmp_path: Path, way: str, suffix: str) -> None:
    _lose(tmp_path, way, suffix, 0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_acknowledged_is_lost_in_112_losses(tmp_path: Path) -> None:
    for seed in range(7):
        for number, (way, suffix) in enumerate(CASES):
            folder = tmp_path / f"{seed}-{number}"
            folder.mkdir()
            _lose(folder, way, suffix, seed + 1)


def test_a_loss_is_noticed_and_rescued_without_an_edit(project: Project, project_path: Path) -> None:
    project.apply("Note", {Key.review(0): Review(note="a")})
    project.check()
    assert project.storage_failure is None
    project_path.unlink()
    project.check()
    assert "was deleted while it was open" in (project.storage_failure or "")
    project.close()
    assert "was deleted while it was open" in (project.storage_failure or "")
    with Project(IDENTITY, project.path, read_only=True) as again:
        assert again.state.review(0).note == "a"


def test_a_failed_rescue_is_retried(project: Project, project_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project.apply("Note", {Key.review(0): Review(note="a")})
    project_path.unlink()
    monkeypatch.setattr(store, "write_new", lambda path, content: False)
    with pytest.raises(ProjectError, match=r"NOT SAVED.*was deleted while it was open"):
        project.apply("Note", {Key.review(0): Review(note="b")})
    assert not project.safe and project.state.review(0).note == "a"
    monkeypatch.undo()
    project.apply("Note", {Key.review(0): Review(note="b")})
    assert project.safe and [step.name for step in project.history()] == ["Note", "Note"]


def test_failing_to_save_at_close_raises(project: Project, project_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project.apply("Note", {Key.review(0): Review(note="a")})
    project_path.unlink()
    monkeypatch.setattr(store, "write_new", lambda path, content: False)
    with pytest.raises(ProjectError, match="NOT SAVED"):
        project.close()


def test_touching_a_project_is_no_loss(project: Project, project_path: Path) -> None:
    project.apply("Note", {Key.review(0): Review(note="a")})
    os.utime(project_path)
    os.utime(project_path.with_name("small.carts-wal"))
    project.apply("Note", {Key.review(0): Review(note="b")})
    assert project.storage_failure is None and project.path == project_path


def test_the_log_of_a_deleted_project_is_not_replayed(project: Project, project_path: Path) -> None:
    project.apply("Note", {Key.review(0): Review(note="a")})
    project_path.unlink()
    project.check()
    with Project(IDENTITY, project_path) as new:
        assert new.writable and not new.history()
