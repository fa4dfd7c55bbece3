"""Kills at random moments and full disks lose no acknowledged edit."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from other_process import CONTEXT, edit_until_killed
from project_model import IDENTITY, ProjectModel, act, visible
from sql_file import rows

from carts_core.project import Project


def _survive(path: Path, seed: int, delay: float, model: ProjectModel) -> ProjectModel:
    """Let a process edit the project, kill it, and check the file; returns the matching model."""
    here, there = CONTEXT.Pipe(duplex=False)
    process = CONTEXT.Process(target=edit_until_killed, args=(path, seed, there))
    process.start()
    there.close()
    assert here.recv() == "ready"
    process.join(delay)
    process.kill()
    process.join()
    acknowledged = 0
    try:
        while True:
            acknowledged = here.recv() + 1
    except (EOFError, OSError):  # A last message that was cut off was not acknowledged in full.
        here.close()
    assert process.exitcode == -9, "the process ended by itself"
    for number in range(acknowledged):
        act(seed, number, model)
    assert rows(path, "PRAGMA integrity_check") == [("ok",)]
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
    assert model.names


def test_nothing_acknowledged_is_lost_when_the_process_is_killed(project_path: Path) -> None:
    _survive_kills(project_path, 5)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_acknowledged_is_lost_in_200_kills(project_path: Path) -> None:
    _survive_kills(project_path, 200)


def _run_on_a_full_disk(folder: Path, how: str, *prefix: str) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [*prefix, sys.executable, str(Path(__file__).with_name("full_disk.py")), str(folder), how]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
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
