"""A process that edits a project is killed at any moment: nothing acknowledged is lost."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from project_model import IDENTITY, ProjectModel, act, visible
from sql_file import rows

from carts_core.project import Project


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
    assert len(model.names) > kills


def test_nothing_acknowledged_is_lost_when_the_process_is_killed(project_path: Path) -> None:
    _survive_kills(project_path, 5)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_nothing_acknowledged_is_lost_in_200_kills(project_path: Path) -> None:
    _survive_kills(project_path, 200)
