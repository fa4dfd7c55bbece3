"""Projects of older schemas are migrated, or are left as they were."""

from pathlib import Path

import pytest
from project_model import IDENTITY, ProjectModel, act, visible
from sql_file import edit_file, rows

from carts_core.errors import ProjectError
from carts_core.project import Key, Project, Review, ReviewState, database

ACCEPTED = Review(ReviewState.ACCEPTED, "clean")


def _version_1(path: Path) -> None:
    edit_file(path, Path(__file__).with_name("version_1.sql").read_text(encoding="utf-8"))


def test_a_project_that_the_first_version_wrote_still_opens(project_path: Path) -> None:
    _version_1(project_path)
    model = ProjectModel()
    for number in range(40):
        act(216, number, model)
    for read_only in (True, False):
        with Project(IDENTITY, project_path, read_only=read_only) as project:
            assert visible(project.state) == model.visible()
    assert rows(project_path, "PRAGMA user_version") == [(len(database.MIGRATIONS),)]


NEXT_VERSION = """
ALTER TABLE steps ADD COLUMN author TEXT NOT NULL DEFAULT 'unknown';
UPDATE changes SET value = json_set(value, '$.note', 'migrated') WHERE kind = 'review' AND value IS NOT NULL;
"""


def test_older_projects_are_migrated_when_opened_for_writing(
    project_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
