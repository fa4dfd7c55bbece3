"""The project file: its path, lock, content and schema, and readers beside the writer."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import pytest
from other_process import CONTEXT, hold
from project_model import HAND, IDENTITY, ProjectModel, act, visible
from sql_file import edit_file, rows

from carts_core.errors import ProjectError
from carts_core.project import (
    CorrectedTransform,
    JointCorrection,
    Key,
    Project,
    Review,
    ReviewState,
    database,
    default_path,
    file,
)
from carts_core.project.layers import Layer
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence

ACCEPTED = Review(ReviewState.ACCEPTED, "clean")


@contextmanager
def _other_process(path: Path, *, writable: bool) -> Iterator[ForkServerProcess]:
    """Another process that has the project open, until it is killed."""
    here, there = CONTEXT.Pipe(duplex=False)
    process = CONTEXT.Process(target=hold, args=(path, there), daemon=True)
    process.start()
    assert here.recv() is writable
    try:
        yield process
    finally:
        process.kill()
        process.join()


def test_a_closed_project_is_one_file(project: Project, project_path: Path) -> None:
    project.apply("Accept", {Key.review(0): ACCEPTED})
    project.close()
    assert os.listdir(project_path.parent) == [project_path.name]
    assert rows(project_path, "PRAGMA journal_mode") == [("wal",)]


def test_writes_wait_for_the_disk(project: Project) -> None:
    assert project._store is not None
    connection = project._store._usable()._usable()
    assert connection.execute("PRAGMA synchronous").fetchone() == (2,), "2 is FULL"


def test_the_file_can_be_read_with_plain_sql(project: Project, project_path: Path) -> None:
    project.apply("Drag", {Key.joints(1, "PSM2"): JointCorrection((0.25, 0.5), HAND)})
    project.apply("Accept", {Key.review(1): ACCEPTED})
    project.apply("Reject", {Key.review(1): Review(ReviewState.REJECTED)})
    project.undo()
    project.close()
    query = "SELECT frame, name, json_extract(value, '$.joint_positions[1]') FROM current"
    assert rows(project_path, query + " WHERE kind = 'joints'") == [(1, "PSM2", 0.5)]
    assert rows(project_path, "SELECT json_extract(value, '$.state') FROM current WHERE kind = 'review'") == [
        ("accepted",)
    ]


def test_a_project_at_its_limit_refuses_edits_and_opens_again(
    project_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file, "LARGEST", file.MAX_LOG_BYTES + 400_000)
    saved = 0
    with Project(IDENTITY, project_path) as project:
        with pytest.raises(ProjectError, match=r"has reached the limit of .* Continue in a new project"):
            while saved < 100:
                project.apply("Note", {Key.review(0): Review(note=f"{saved}" + 9_000 * "x")})
                saved += 1
        assert project.writable and len(project.state.steps) == saved
    assert 10 < saved < 100 and project_path.stat().st_size <= 400_000
    with Project(IDENTITY, project_path) as project:
        assert project.writable and project.state.review(0).note.startswith(f"{saved - 1}x")


def test_a_second_process_opens_read_only_and_says_so_until_the_first_is_killed(project_path: Path) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    with _other_process(project_path, writable=True) as writer:
        with Project(IDENTITY, project_path) as second:
            assert not second.writable
            assert second.read_only_reason is not None
            assert f"open for writing elsewhere (process {writer.pid} on " in second.read_only_reason
            assert second.state.review(0) == ACCEPTED
            with pytest.raises(ProjectError, match=f"cannot be changed.*process {writer.pid}"):
                second.apply("Reject", {Key.review(0): None})
        writer.kill()
        writer.join()
        with Project(IDENTITY, project_path) as third:
            assert third.writable and third.state.review(0) == ACCEPTED


def test_a_link_to_the_folder_of_a_project_leads_to_the_same_project(project: Project, project_path: Path) -> None:
    link = project_path.parent / "link"
    link.symlink_to(project_path.parent)
    with Project(IDENTITY, link / project_path.name) as second:
        assert not second.writable and second.path == project.path


def test_the_project_is_created_beside_its_sequence(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    sequence = Sequence.open(tiny_sequence())
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    joints = JointCorrection(tuple(sequence.measured["PSM1"][0]), HAND)
    with Project.open(sequence) as project:
        assert project.path == (tmp_path / "sequence.carts").resolve()
        project.apply("Copy", {Key.joints(0, "PSM1"): joints})
        moved = CorrectedTransform(tuple(map(tuple, sequence.scene.cameras[0].T_camera_world)), HAND)
        project.apply("Calibrate", {Key.extrinsics("left"): moved})
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert after.keys() - before.keys() == {tmp_path / "sequence.carts"}
    assert {path: after[path] for path in before} == before


def test_a_project_survives_moving_its_folder(tiny_sequence: Callable[..., Path], tmp_path: Path) -> None:
    path = tiny_sequence()
    with Project.open(Sequence.open(path)) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    moved = tmp_path.rename(tmp_path.with_name("moved away"))
    file, table = moved / path.name, moved / "kinematics.csv"
    file.write_text(file.read_text().replace('name = "tiny"', 'name = "large"', 1) + "[light]\nambient = 0.5\n")
    table.write_bytes(table.read_bytes().replace(b"\r\n", b"\n"))
    with Project.open(Sequence.open(file)) as project:
        assert project.state.review(0) == ACCEPTED
    table.write_text(table.read_text().replace("0.1", "0.2", 1))
    with pytest.raises(ProjectError, match="the kinematics tables differ"):
        Project.open(Sequence.open(file))


def test_the_shipped_sequence_has_its_project_in_the_user_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert default_path(sample_sequence()).parent == Path(os.environ["CARTS_DATA"])
    monkeypatch.delenv("CARTS_DATA")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert default_path(sample_sequence()).parent == tmp_path / "xdg" / "carts"


def test_sequences_in_read_only_folders_have_own_projects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The superuser may write anywhere, so the system's answer is replaced.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    first, second = (default_path(tmp_path / folder / "sequence.toml") for folder in ("a", "b"))
    assert first.parent == second.parent == Path(os.environ["CARTS_DATA"]) and first != second
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "sequence.carts").touch()
    assert default_path(tmp_path / "a" / "sequence.toml") == tmp_path / "a" / "sequence.carts"


NOTE = {Key.review(0): Review(note="a")}


def test_the_lock_outlives_another_descriptor_of_the_file_that_is_closed(project: Project, project_path: Path) -> None:
    project_path.read_bytes()
    with Project(IDENTITY, project_path) as second:
        assert not second.writable and "open for writing elsewhere" in (second.read_only_reason or "")
    with _other_process(project_path, writable=False):
        pass


def test_other_programs_that_use_sqlite_cannot_write_meanwhile(project: Project, project_path: Path) -> None:
    with pytest.raises(sqlite3.OperationalError, match="locked"):
        sqlite3.connect(project_path, timeout=0).execute("DELETE FROM steps")
    project.apply("Note", NOTE)
    project.close()
    with sqlite3.connect(project_path, timeout=0) as connection:
        assert connection.execute("SELECT count(*) FROM steps").fetchone() == (1,)


def _version_1(path: Path) -> None:
    edit_file(path, Path(__file__).with_name("version_1.sql").read_text(encoding="utf-8"))


def _decoded(shown: dict[str, Any]) -> dict[str, Any]:
    """The same with pixels in place of PNG files, which another version may have encoded."""
    values = shown["values"].items()
    return {**shown, "values": {k: (type(v), v.pixels().tolist()) if isinstance(v, Layer) else v for k, v in values}}


def test_a_project_that_the_first_version_wrote_still_opens(project_path: Path) -> None:
    _version_1(project_path)
    model = ProjectModel()
    for number in range(40):
        act(216, number, model)
    for read_only in (True, False):
        with Project(IDENTITY, project_path, read_only=read_only) as project:
            assert _decoded(visible(project.state)) == _decoded(model.visible())
    assert rows(project_path, "PRAGMA user_version") == [(len(database.MIGRATIONS),)]


NEXT_VERSION = """
ALTER TABLE steps ADD COLUMN author TEXT NOT NULL DEFAULT 'unknown';
UPDATE changes SET value = json_set(value, '$.note', 'migrated') WHERE kind = 'review' AND value IS NOT NULL;
"""


def test_projects_are_migrated_when_opened_for_writing(project_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    before = project_path.read_bytes()
    next_version = len(database.MIGRATIONS) + 1
    monkeypatch.setattr(database, "MIGRATIONS", (*database.MIGRATIONS, NEXT_VERSION))
    with Project(IDENTITY, project_path, read_only=True) as project:
        assert project.state.review(0).note == "migrated"
    assert project_path.read_bytes() == before, "reading must not migrate the file"
    with Project(IDENTITY, project_path) as project:
        assert project.state.review(0).note == "migrated"
    assert rows(project_path, "PRAGMA user_version") == [(next_version,)]
    assert rows(project_path, "SELECT author FROM steps") == [("unknown",)]


def test_a_migration_that_fails_changes_nothing(project_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    monkeypatch.setattr(database, "MIGRATIONS", (*database.MIGRATIONS, NEXT_VERSION + "DROP TABLE never_was;"))
    with pytest.raises(ProjectError, match="never_was"):
        Project(IDENTITY, project_path)
    monkeypatch.undo()
    with Project(IDENTITY, project_path) as project:
        assert project.writable and project.state.review(0) == ACCEPTED
