"""The file: whom it opens for, where it lies, and what it says to others."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from project_model import HAND, IDENTITY
from sql_file import rows

from carts_core.errors import ProjectError
from carts_core.project import CorrectedTransform, JointCorrection, Key, Project, Review, ReviewState
from carts_core.recording import Sequence

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


def test_a_link_to_the_folder_of_a_project_leads_to_the_same_project(project: Project, project_path: Path) -> None:
    link = project_path.parent / "link"
    link.symlink_to(project_path.parent)
    with Project(IDENTITY, link / project_path.name) as second:
        assert not second.writable and second.path == project.path


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
