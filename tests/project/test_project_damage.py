"""Damaged, crafted and foreign project files are refused and left unchanged."""

import json
import os
import random
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from project_model import FRAMES, IDENTITY, act, visible
from sql_file import edit_file, rows

from carts_core.errors import ProjectError
from carts_core.project import Key, Project, Review, ReviewState, database
from carts_core.project.database import seal

NOTE = {Key.review(0): Review(note="a")}


def _all_states(path: Path) -> list[dict]:
    """State of a project after each step of its history, including values that undo restores."""
    with Project(IDENTITY, path) as project:
        assert project.writable
        position, states = project.state.position, []
        states.append(visible(project.state))
        for step in range(len(project.history()) + 1):
            project.go_to(step)
            states.append({**visible(project.state), "all figures": [project.state.figures(frame) for frame in FRAMES]})
        project.go_to(position)
    return states


def _make(folder: Path, *, closed: bool) -> Path:
    """Project with many kinds of values and undone steps; closed, or in the state after a kill."""
    path = folder / "small.carts"
    project = Project(IDENTITY, path)
    for number in range(40):
        act(216, number, project)
    if closed:
        project.close()
    target = folder / "kept"
    target.mkdir()
    for file in folder.glob("small.carts*"):
        shutil.copy(file, target)
    project.close()
    return target / "small.carts"


def _flip_bits(folder: Path, count: int, *, closed: bool) -> dict[str, int]:
    """Flip one bit of one file at a time; how often that was harmless, and how often it was reported."""
    original = _make(folder, closed=closed)
    files = sorted(original.parent.iterdir())
    assert (len(files) == 2) is not closed
    attempt = folder / "attempt"
    shutil.copytree(original.parent, attempt)
    expected = _all_states(attempt / original.name)
    dice, tally = random.Random(count + closed), {"same": 0, "reported": 0, "rescued": 0}
    for _ in range(count):
        shutil.rmtree(attempt)
        shutil.copytree(original.parent, attempt)
        file = attempt / dice.choice(files).name
        content = bytearray(file.read_bytes())
        bit = dice.randrange(8 * len(content))
        content[bit // 8] ^= 1 << bit % 8
        file.write_bytes(content)
        before = {path.name: path.read_bytes() for path in attempt.iterdir()}
        try:
            found = _all_states(attempt / original.name)
        except ProjectError as error:
            tally["reported"] += 1
            tally["rescued"] += "rescued" in str(error)
            after = {path.name: path.read_bytes() for path in attempt.iterdir() if "rescued" not in path.name}
            assert after == before, f"bit {bit} of {file.name}: the damaged file was changed"
            for rescued in attempt.glob("*.rescued-*"):
                Project(IDENTITY, rescued).close()
        else:
            assert found == expected, f"bit {bit} of {file.name} changed a value and nobody noticed"
            tally["same"] += 1
    return tally


@pytest.mark.parametrize("closed", [True, False])
def test_a_flipped_bit_changes_nothing_or_is_reported(tmp_path: Path, closed: bool) -> None:
    tally = _flip_bits(tmp_path, 40, closed=closed)
    assert tally["reported"] > 5 and tally["rescued"] > 5, tally


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("closed", [True, False])
def test_none_of_1000_flipped_bits_goes_unnoticed(tmp_path: Path, closed: bool) -> None:
    print(_flip_bits(tmp_path, 500, closed=closed))


CRAFTED: dict[str, str] = {
    "a view in place of a table": "ALTER TABLE steps RENAME TO s; CREATE VIEW steps AS SELECT * FROM s",
    "a view that never ends": """DROP VIEW current; CREATE VIEW current AS WITH RECURSIVE n(i) AS
        (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT 'review' kind, i frame, '' name, 1 step, '{}' value FROM n""",
    "a trigger that drops edits": "CREATE TRIGGER t AFTER INSERT ON changes BEGIN DELETE FROM changes; END",
    "a trigger on the position": "CREATE TRIGGER t AFTER UPDATE ON project BEGIN DELETE FROM steps; END",
    "another table": "CREATE TABLE more (x)",
    "another index": "CREATE INDEX more ON changes (abs(step))",
    "a column that computes": "ALTER TABLE steps ADD COLUMN x AS (length(zeroblob(100000000)))",
    "a virtual table": "CREATE VIRTUAL TABLE more USING fts5(x)",
    "a huge blob": "UPDATE changes SET value = zeroblob(140000000)",
    "text where a number belongs": "UPDATE steps SET time = 'soon'",
    "a number where text belongs": "UPDATE changes SET value = 7",
    "a frame that is a float": "UPDATE changes SET frame = 1e300",
    "a position beyond all numbers": "UPDATE project SET position = 9223372036854775807",
    "a position that is text": "UPDATE project SET position = 'x'",
    "an identity of another form": 'UPDATE project SET identity = \'{"name": 1, "frame_ids": 2}\'',
    "two identities": "INSERT INTO project SELECT * FROM project",
    "deep JSON": f"UPDATE changes SET value = '{'[' * 100_000}'",
    "a huge number": f'UPDATE changes SET value = \'{{"joint_positions": [{"9" * 4000}], "provenance": 1}}\'',
    "a nonce that is text": "UPDATE seal SET nonce = 'abc'",
    "no seal": "DELETE FROM seal",
    "an older version": "PRAGMA user_version = 1",
    "version 0": "PRAGMA user_version = 0",
    "a negative version": "PRAGMA user_version = -1",
    "a step far away": "INSERT INTO steps SELECT step + 1000000000, name, time, digest FROM steps",
}


@pytest.mark.parametrize("sealed", [False, True], ids=["as it is", "with right digests"])
@pytest.mark.parametrize("script", CRAFTED.values(), ids=CRAFTED.keys())
def test_a_crafted_file_is_refused_in_words_and_soon(project_path: Path, script: str, sealed: bool) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Note", NOTE)
    edit_file(project_path, script)
    if sealed:
        _seal_again(project_path)
    before = project_path.read_bytes()
    for read_only in (True, False):
        began = time.monotonic()
        try:
            with Project(IDENTITY, project_path, read_only=read_only) as project:
                assert project.state.review(0).note == "a" or not project.history()
        except ProjectError:
            assert project_path.read_bytes() == before
        assert time.monotonic() - began < 10


def _seal_again(path: Path) -> None:
    """What an attacker does who knows how digests are made."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        try:
            connection.execute("BEGIN")
            seal(connection, bytes(16))
            connection.execute("COMMIT")
        except (sqlite3.Error, TypeError, AttributeError, OverflowError, ValueError):
            pytest.skip("it has no place for digests")


def test_the_seal_is_about_everything(project: Project, project_path: Path) -> None:
    project.apply("Note", NOTE)
    project.close()
    assert rows(project_path, "PRAGMA user_version") == [(len(database.MIGRATIONS),)]
    text = json.loads(rows(project_path, "SELECT identity FROM project")[0][0]) | {"name": "another"}
    edit_file(project_path, f"UPDATE project SET identity = '{json.dumps(text)}'")
    with pytest.raises(ProjectError, match="its position or identity was changed"):
        Project(IDENTITY, project_path)


@pytest.mark.parametrize("suffix", ["", "-wal", "-journal"])
@pytest.mark.parametrize("make", ["link", "dangling link", "hard link", "pipe", "folder"])
def test_planted_links_and_special_files_are_refused(tmp_path: Path, suffix: str, make: str) -> None:
    victim, planted = tmp_path / "victim", tmp_path / f"small.carts{suffix}"
    victim.write_text("precious")
    if suffix:
        Project(IDENTITY, tmp_path / "small.carts").close()
    plant: dict[str, Callable[[], object]] = {
        "link": lambda: planted.symlink_to(victim),
        "dangling link": lambda: planted.symlink_to(tmp_path / "nowhere"),
        "hard link": lambda: planted.hardlink_to(victim),
        "pipe": lambda: os.mkfifo(planted),
        "folder": planted.mkdir,
    }
    plant[make]()
    names = {path.name for path in tmp_path.iterdir()}
    for read_only in (True, False):
        with pytest.raises(ProjectError, match=r"nothing was changed|Nothing was changed"):
            Project(IDENTITY, tmp_path / "small.carts", read_only=read_only)
    assert victim.read_text() == "precious" and {path.name for path in tmp_path.iterdir()} == names


def test_a_lock_file_of_any_kind_is_not_looked_at(project_path: Path) -> None:
    victim = project_path.with_name("victim")
    victim.write_text("precious")
    project_path.with_name("small.carts.lock").symlink_to(victim)
    project_path.with_name("small.carts.part").symlink_to(victim)
    project_path.with_name("small.carts-shm").symlink_to(victim)
    with Project(IDENTITY, project_path) as project:
        project.apply("Note", NOTE)
    assert victim.read_text() == "precious"


def test_a_journal_that_names_another_file_deletes_nothing(project_path: Path) -> None:
    """SQLite plays back a journal that it finds, and removes the file that it names as its super-journal."""
    Project(IDENTITY, project_path).close()
    victim = project_path.with_name("victim")
    victim.write_text("precious")
    project_path.with_name("small.carts-journal").write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(504))
    with pytest.raises(ProjectError, match="carts does not create such files"):
        Project(IDENTITY, project_path)
    assert victim.read_text() == "precious"


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
        ({"frame_ids": ("001", "002")}, "3 frames in one and 2 in the other"),
        ({"frame_ids": ("001", "002", "004")}, "frame number 2 is named '003' in one and '004' in the other"),
        ({"arms": {"PSM1": ("yaw",)}}, "arms PSM1 .yaw pitch insertion., PSM2 .yaw pitch. in one and PSM1 .yaw. .*"),
        ({"cameras": {"left": (8, 4)}}, "cameras left .8 6. in one and left .8 4. in the other"),
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
