"""A process that edits a project is killed at any moment: nothing acknowledged is lost."""

from pathlib import Path

import pytest
from other_process import CONTEXT, edit_until_killed
from project_model import IDENTITY, ProjectModel, act, visible
from sql_file import rows

from carts_core.project import Project


def _survive(path: Path, seed: int, delay: float, model: ProjectModel) -> ProjectModel:
    """Let a process edit the project, kill it, and check what is left; gives the model that agrees with it."""
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
