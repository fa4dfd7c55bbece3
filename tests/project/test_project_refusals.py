"""What cannot be opened, or not for writing, is a clear error and is left alone."""

import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from project_model import IDENTITY
from sql_file import edit_file

from carts_core.errors import ProjectError
from carts_core.project import Key, Project, Review, ReviewState

ACCEPTED = Review(ReviewState.ACCEPTED, "clean")


@pytest.fixture
def ordinary_user_folder() -> Iterator[Path]:
    """A folder that belongs to this user, who is not the superuser here: that one may write anywhere."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if os.geteuid() != 0:
            yield folder
            return
        try:
            os.chown(folder, 65534, -1)
        except OSError:
            pytest.skip("a container without other users, whose superuser may write anywhere")
        os.seteuid(65534)
        try:
            yield folder
        finally:
            os.seteuid(0)


def test_a_read_only_folder_is_an_error_and_can_be_opened_read_only(ordinary_user_folder: Path) -> None:
    path = ordinary_user_folder / "small.carts"
    with Project(IDENTITY, path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    before = path.read_bytes()
    ordinary_user_folder.chmod(0o555)
    for name in ("small.carts", "new.carts"):
        with pytest.raises(ProjectError, match=r"Choose a file in a writable folder, or open .* read-only"):
            Project(IDENTITY, path.with_name(name))
    with Project(IDENTITY, path, read_only=True) as reader:
        assert reader.state.review(0) == ACCEPTED
        assert reader.read_only_reason == "It was opened read-only."
    ordinary_user_folder.chmod(0o755)
    assert os.listdir(ordinary_user_folder) == ["small.carts"] and path.read_bytes() == before


def test_a_file_that_may_not_be_written_is_an_error_when_it_is_opened(ordinary_user_folder: Path) -> None:
    path = ordinary_user_folder / "small.carts"
    Project(IDENTITY, path).close()
    path.chmod(0o444)
    with pytest.raises(ProjectError, match=r"Permission denied. Choose a file in a writable folder"):
        Project(IDENTITY, path)


def test_opening_read_only_begins_no_project(project_path: Path) -> None:
    with pytest.raises(ProjectError, match="there is no project"):
        Project(IDENTITY, project_path, read_only=True)
    assert not project_path.exists()


@pytest.mark.parametrize("read_only", [False, True])
def test_a_project_of_a_newer_schema_is_refused_and_left_alone(project_path: Path, read_only: bool) -> None:
    Project(IDENTITY, project_path).close()
    edit_file(project_path, "CREATE TABLE news (x); PRAGMA user_version = 99")
    before = project_path.read_bytes()
    with pytest.raises(ProjectError, match=r"has schema 99, written by a newer version of carts.* Update carts"):
        Project(IDENTITY, project_path, read_only=read_only)
    assert project_path.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"format = 'carts-sequence/1'\n" * 100, "database"])
def test_a_file_that_is_no_project_is_refused_and_left_alone(project_path: Path, content: bytes | str) -> None:
    if isinstance(content, bytes):
        project_path.write_bytes(content)
    else:
        edit_file(project_path, "CREATE TABLE precious (x)")
    before = project_path.read_bytes()
    for read_only in (False, True):
        with pytest.raises(ProjectError, match=r"not a .*project.* nothing was changed. Choose another file"):
            Project(IDENTITY, project_path, read_only=read_only)
    assert project_path.read_bytes() == before


@pytest.mark.parametrize(
    ("changed", "difference"),
    [
        ({"frame_ids": ("001", "002")}, "3 frames against 2"),
        ({"frame_ids": ("001", "002", "004")}, "frame number 2 is named '003' in one and '004' in the other"),
        ({"arms": {"PSM1": ("yaw",)}}, "arms PSM1 .yaw pitch insertion., PSM2 .yaw pitch. against PSM1 .yaw."),
        ({"cameras": {"left": (8, 4)}}, "cameras left .8 6. against left .8 4."),
        ({"kinematics_sha256": "1" * 64}, "the kinematics tables differ"),
    ],
)
def test_a_project_of_another_sequence_is_refused(project_path: Path, changed: dict, difference: str) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    before = project_path.read_bytes()
    for read_only in (False, True):
        with pytest.raises(ProjectError, match=f"belongs to another sequence .*{difference}. Nothing was changed"):
            Project(replace(IDENTITY, **changed), project_path, read_only=read_only)
    assert project_path.read_bytes() == before


def test_a_file_that_was_cut_off_is_a_clear_error(project_path: Path) -> None:
    with Project(IDENTITY, project_path) as project:
        for number in range(20):
            project.apply("Note", {Key.review(0): Review(note=f"{number} " + "long " * 1000)})
    project_path.write_bytes(project_path.read_bytes()[:8192])
    with pytest.raises(ProjectError, match=r"is damaged: .*not changed"):
        Project(IDENTITY, project_path)
