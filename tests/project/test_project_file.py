"""The file: whom it opens for, what it survives, and that whatever goes wrong harms nothing."""

import os
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from project_model import HAND, IDENTITY, ProjectModel, act, visible

from carts_core.data import Sequence
from carts_core.errors import ProjectError
from carts_core.project import CorrectedTransform, JointCorrection, Key, Project, Review, ReviewState, database

ACCEPTED = Review(ReviewState.ACCEPTED, "clean")


@contextmanager
def _writer_process(path: Path) -> Iterator[subprocess.Popen]:
    """Another process that has the project open for writing, until it is killed."""
    program = (
        "import sys, time; from pathlib import Path; from project_model import IDENTITY;"
        "from carts_core.project import Project; project = Project(IDENTITY, Path(sys.argv[1]));"
        "print(project.writable, flush=True); time.sleep(600)"
    )
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": paths}
    command = [sys.executable, "-c", program, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None and process.stdout.readline() == "True\n"
        try:
            yield process
        finally:
            process.kill()


def _rows(path: Path, query: str) -> list[tuple]:
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
        return connection.execute(query).fetchall()


def _edit_file(path: Path, script: str) -> None:
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(script)


def test_a_closed_project_is_one_file(project: Project, project_path: Path) -> None:
    project.apply("Accept", {Key.review(0): ACCEPTED})
    project.close()
    assert os.listdir(project_path.parent) == [project_path.name]
    assert _rows(project_path, "PRAGMA journal_mode") == [("wal",)]


def test_writes_wait_for_the_disk(project: Project) -> None:
    assert project._connection is not None
    assert project._connection.execute("PRAGMA synchronous").fetchone() == (2,), "2 is FULL"


def test_the_file_can_be_read_with_plain_sql(project: Project, project_path: Path) -> None:
    project.apply("Drag", {Key.joints(1, "PSM2"): JointCorrection((0.25, 0.5), HAND)})
    project.apply("Accept", {Key.review(1): ACCEPTED})
    project.apply("Reject", {Key.review(1): Review(ReviewState.REJECTED)})
    project.undo()
    query = "SELECT frame, name, json_extract(value, '$.joint_positions[1]') FROM current"
    assert _rows(project_path, query + " WHERE kind = 'joints'") == [(1, "PSM2", 0.5)]
    assert _rows(project_path, "SELECT json_extract(value, '$.state') FROM current WHERE kind = 'review'") == [
        ("accepted",)
    ]


def test_a_second_process_opens_read_only_and_says_so_until_the_first_is_killed(project_path: Path) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    with _writer_process(project_path) as writer:
        with Project(IDENTITY, project_path) as second:
            assert not second.writable
            assert second.read_only_reason is not None
            assert f"open for writing elsewhere (process {writer.pid} on " in second.read_only_reason
            assert second.state.review(0) == ACCEPTED
            with pytest.raises(ProjectError, match=f"cannot be changed.*process {writer.pid}"):
                second.apply("Reject", {Key.review(0): None})
        writer.kill()
        writer.wait()
        with Project(IDENTITY, project_path) as third:
            assert third.writable and third.state.review(0) == ACCEPTED


def test_a_second_opening_in_the_same_process_is_read_only_too(project: Project, project_path: Path) -> None:
    project.apply("Accept", {Key.review(0): ACCEPTED})
    with Project(IDENTITY, project_path) as second:
        assert not second.writable and second.state.review(0) == ACCEPTED
    assert project.writable
    project.apply("Reject", {Key.review(0): None})


def test_a_link_to_a_project_is_the_same_project(project: Project, project_path: Path) -> None:
    link = project_path.with_name("link.carts")
    link.symlink_to(project_path)
    with Project(IDENTITY, link) as second:
        assert not second.writable


def _survive(path: Path, seed: int, delay: float, model: ProjectModel) -> ProjectModel:
    """Let a process edit the project, kill it, and check what is left; gives the model that agrees with it."""
    command = [sys.executable, str(Path(__file__).with_name("victim.py")), str(path), str(seed)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            process.kill()
        # A last line without its end was not acknowledged in full.
        acknowledged = process.stdout.read().count("\n")
    assert process.returncode == -9, "the process ended by itself"
    for number in range(acknowledged):
        act(seed, number, model)
    assert _rows(path, "PRAGMA integrity_check") == [("ok",)]
    with Project(IDENTITY, path) as project:
        assert project.writable
        left = visible(project.state)
    if left != model.visible():
        # The action during which it was killed may be there, but only as a whole.
        act(seed, acknowledged, model)
    assert left == model.visible(), f"after {acknowledged} acknowledged actions of seed {seed}"
    return model


def _survive_kills(path: Path, kills: int) -> None:
    model = ProjectModel()
    for seed in range(kills):
        model = _survive(path, seed, 0.001 + 0.3 * (seed * 0.618034 % 1), model)
    assert len(model.names) > kills


def test_nothing_acknowledged_is_lost_when_the_process_is_killed(project_path: Path) -> None:
    _survive_kills(project_path, 10)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_acknowledged_is_lost_in_200_kills(project_path: Path) -> None:
    _survive_kills(project_path, 200)


FILL_THE_DISK = """
import os, resource, sqlite3, sys
from pathlib import Path
import numpy as np
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
        assert "Nothing of this was saved" in str(error) and "Free space" in str(error), error
        assert visible(project.state) == before
        return True
    return False

project = Project(IDENTITY, path)
for number in range(20):
    edit(number)
fill()
while not refused(lambda: edit(number + 1)):
    number += 1
assert refused(lambda: edit(number + 1))
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
        assert "Free space" in str(error), error
    with Project(IDENTITY, path, read_only=True) as reader:
        assert visible(reader.state) == kept
    try:
        Project(IDENTITY, folder / "other.carts")
        raise SystemExit("began a project on a full disk")
    except ProjectError as error:
        assert "Free space" in str(error), error
    assert path.read_bytes() == before
    assert not list(folder.glob("other*")), os.listdir(folder)
    free()
with Project(IDENTITY, path) as project:
    assert visible(project.state) == kept
assert sqlite3.connect(path).execute("PRAGMA integrity_check").fetchone() == ("ok",)
print("kept", number)
"""


def _run_on_a_full_disk(folder: Path, how: str, *prefix: str) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [*prefix, sys.executable, "-c", FILL_THE_DISK, str(folder), how]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=environment)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("kept ")


def test_a_file_that_may_not_grow_refuses_edits_and_keeps_what_it_has(tmp_path: Path) -> None:
    _run_on_a_full_disk(tmp_path, "limit")


def test_a_full_disk_refuses_edits_and_keeps_what_it_has(tmp_path: Path) -> None:
    own_mounts = ("unshare", "--map-root-user", "--mount")
    try:
        subprocess.run([*own_mounts, "mount", "-t", "tmpfs", "none", str(tmp_path)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine lets nobody mount a small disk")
    _run_on_a_full_disk(tmp_path, "tmpfs", *own_mounts)


@pytest.fixture
def ordinary_user_folder() -> Iterator[Path]:
    """A folder that belongs to this user, who is not the superuser here: that one may write anywhere."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if os.geteuid() != 0:
            yield folder
            return
        os.chown(folder, 65534, -1)
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
        with pytest.raises(ProjectError, match=r"Name a file in a folder that you may write to, or open .* read-only"):
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
    with pytest.raises(ProjectError, match=r"readonly database. Name a file in a folder that you may write to"):
        Project(IDENTITY, path)


def test_opening_read_only_begins_no_project(project_path: Path) -> None:
    with pytest.raises(ProjectError, match="there is no project"):
        Project(IDENTITY, project_path, read_only=True)
    assert not project_path.exists()


@pytest.mark.parametrize("read_only", [False, True])
def test_a_project_of_a_newer_schema_is_refused_and_left_alone(project_path: Path, read_only: bool) -> None:
    Project(IDENTITY, project_path).close()
    _edit_file(project_path, "CREATE TABLE news (x); PRAGMA user_version = 99")
    before = project_path.read_bytes()
    with pytest.raises(ProjectError, match=r"has schema 99, made by a newer version of carts.* Update carts"):
        Project(IDENTITY, project_path, read_only=read_only)
    assert project_path.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"format = 'carts-sequence/1'\n" * 100, "database"])
def test_a_file_that_is_no_project_is_refused_and_left_alone(project_path: Path, content: bytes | str) -> None:
    if isinstance(content, bytes):
        project_path.write_bytes(content)
    else:
        _edit_file(project_path, "CREATE TABLE precious (x)")
    before = project_path.read_bytes()
    for read_only in (False, True):
        with pytest.raises(ProjectError, match=r"not a project.* nothing was changed. Name another file"):
            Project(IDENTITY, project_path, read_only=read_only)
    assert project_path.read_bytes() == before


@pytest.mark.parametrize(
    ("changed", "difference"),
    [
        ({"frame_ids": ("001", "002")}, "3 frames against 2"),
        ({"frame_ids": ("001", "002", "004")}, "frame number 2 is called '003' against '004'"),
        ({"arms": {"PSM1": ("yaw",)}}, "arms PSM1 .yaw pitch insertion., PSM2 .yaw pitch. against PSM1 .yaw."),
        ({"cameras": {"left": (8, 4)}}, "cameras left .8 6. against left .8 4."),
        ({"kinematics_sha256": "1" * 64}, "the kinematics tables differ"),
    ],
)
def test_a_project_of_another_sequence_is_refused_and_left_alone(
    project_path: Path, changed: dict, difference: str
) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    before = project_path.read_bytes()
    for read_only in (False, True):
        with pytest.raises(ProjectError, match=f"belongs to another sequence .*{difference}. Nothing was changed"):
            Project(replace(IDENTITY, **changed), project_path, read_only=read_only)
    assert project_path.read_bytes() == before


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE changes SET value = '{' WHERE kind = 'review'",
        "UPDATE changes SET value = '{\"state\": \"splendid\"}' WHERE kind = 'review'",
        "UPDATE changes SET kind = 'opinion'",
        "UPDATE changes SET frame = 77",
        "UPDATE changes SET value = x'00' WHERE kind = 'joints'",
        "DELETE FROM steps",
        "DELETE FROM project",
        "UPDATE project SET position = 7",
        "UPDATE project SET identity = '[]'",
    ],
)
def test_a_damaged_project_is_a_clear_error(project_path: Path, damage: str) -> None:
    with Project(IDENTITY, project_path) as project:
        joints = JointCorrection((0.0, 0.0), HAND)
        project.apply("Accept", {Key.review(0): ACCEPTED, Key.joints(0, "PSM2"): joints})
    _edit_file(project_path, damage)
    with pytest.raises(ProjectError, match=r"small\.carts is damaged: .* Go back to a copy of it"):
        Project(IDENTITY, project_path)


def test_a_file_that_was_cut_off_is_a_clear_error(project_path: Path) -> None:
    with Project(IDENTITY, project_path) as project:
        for number in range(20):
            project.apply("Note", {Key.review(0): Review(note=f"{number} " + "long " * 1000)})
    project_path.write_bytes(project_path.read_bytes()[:8192])
    with pytest.raises(ProjectError, match=r"malformed.*keep a copy"):
        Project(IDENTITY, project_path)


def _version_1(path: Path) -> None:
    _edit_file(path, Path(__file__).with_name("version_1.sql").read_text(encoding="utf-8"))


def test_a_project_that_the_first_version_wrote_still_opens(project_path: Path) -> None:
    _version_1(project_path)
    model = ProjectModel()
    for number in range(40):
        act(216, number, model)
    for read_only in (True, False):
        with Project(IDENTITY, project_path, read_only=read_only) as project:
            assert visible(project.state) == model.visible()
    assert _rows(project_path, "PRAGMA user_version") == [(len(database.MIGRATIONS),)]


NEXT_VERSION = """
ALTER TABLE steps ADD COLUMN author TEXT NOT NULL DEFAULT 'unknown';
UPDATE changes SET value = json_set(value, '$.note', 'migrated') WHERE kind = 'review' AND value IS NOT NULL;
"""


def test_an_older_project_is_migrated_when_it_is_opened_for_writing(
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
    assert _rows(project_path, "PRAGMA user_version") == [(next_version,)]
    assert _rows(project_path, "SELECT author FROM steps") == [("unknown",)]


def test_a_migration_that_fails_changes_nothing(project_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Project(IDENTITY, project_path) as project:
        project.apply("Accept", {Key.review(0): ACCEPTED})
    monkeypatch.setattr(database, "MIGRATIONS", (*database.MIGRATIONS, NEXT_VERSION + "DROP TABLE never_was;"))
    with pytest.raises(ProjectError, match="never_was"):
        Project(IDENTITY, project_path)
    monkeypatch.undo()
    with Project(IDENTITY, project_path) as project:
        assert project.writable and project.state.review(0) == ACCEPTED


def test_the_project_lies_beside_its_sequence_which_is_never_written_to(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
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


def test_a_project_survives_moving_its_folder_and_correcting_the_sequence_file(
    tiny_sequence: Callable[..., Path], tmp_path: Path
) -> None:
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
