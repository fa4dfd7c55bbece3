"""An open project in a folder of the test's own."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from project_model import IDENTITY

from carts_core.project import Project


@pytest.fixture
def project_path(tmp_path: Path) -> Path:
    """Where `project` lies."""
    return tmp_path / "small.carts"


@pytest.fixture
def project(project_path: Path) -> Iterator[Project]:
    """A new project of the small recording, open for writing."""
    with Project(IDENTITY, project_path) as opened:
        yield opened
