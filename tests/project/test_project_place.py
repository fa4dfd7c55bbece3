"""Default paths of project files."""

import os
from pathlib import Path

import pytest

from carts_core.project import default_path
from carts_core.resources import sample_sequence


def test_a_project_is_beside_its_sequence(tmp_path: Path) -> None:
    assert default_path(tmp_path / "sequence.toml") == tmp_path / "sequence.carts"


def test_the_shipped_sequence_has_its_project_among_the_users_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert default_path(sample_sequence()).parent == Path(os.environ["CARTS_DATA"])
    monkeypatch.delenv("CARTS_DATA")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert default_path(sample_sequence()).parent == tmp_path / "xdg" / "carts"


def test_sequences_of_one_name_in_read_only_folders_have_projects_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The superuser may write anywhere, so the system's answer is replaced.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    first, second = (default_path(tmp_path / folder / "sequence.toml") for folder in ("a", "b"))
    assert first.parent == second.parent == Path(os.environ["CARTS_DATA"]) and first != second
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "sequence.carts").touch()
    assert default_path(tmp_path / "a" / "sequence.toml") == tmp_path / "a" / "sequence.carts"
