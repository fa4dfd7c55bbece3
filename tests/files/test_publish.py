"""Whole or not at all: failures, kills, cancels, and what may be replaced."""

import subprocess
import sys
from pathlib import Path

import pytest

from carts_core.errors import CartsError
from carts_core.files import MARKER, OutputPath, published, write_text


def _make(folder: Path | OutputPath, text: str) -> None:
    write_text(OutputPath(Path(folder)) / MARKER, text)


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_folder_and_a_file_appear_when_the_block_ends(tmp_path: Path) -> None:
    with published(tmp_path / "deep" / "out dir") as path:
        _make(path, "new")
        assert not (tmp_path / "deep" / "out dir").exists()
    with published(tmp_path / "deep" / "ü.csv") as path:
        write_text(path, "new")
    assert _names(tmp_path / "deep") == ["out dir", "ü.csv"]
    assert (tmp_path / "deep" / "ü.csv").read_text() == (tmp_path / "deep" / "out dir" / MARKER).read_text() == "new"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failure_leaves_everything_as_it_was(tmp_path: Path, error: type[BaseException]) -> None:
    _make(tmp_path / "out", "old")
    with pytest.raises(error), published(tmp_path / "out", overwrite=True) as path:
        _make(path, "new")
        raise error
    with pytest.raises(error), published(tmp_path / "other") as path:
        _make(path, "new")
        raise error
    assert _names(tmp_path) == ["out"] and (tmp_path / "out" / MARKER).read_text() == "old"


def test_what_exists_is_replaced_on_request_only(tmp_path: Path) -> None:
    _make(tmp_path / "out", "old")
    (tmp_path / "out.csv").write_text("old")
    for name in ("out", "out.csv"):
        with pytest.raises(CartsError, match=f"{name} exists. Add --overwrite"), published(tmp_path / name):
            pass
    with published(tmp_path / "out", overwrite=True) as path:
        _make(path, "new")
    with published(tmp_path / "out.csv", overwrite=True) as path:
        write_text(path, "new")
    assert (tmp_path / "out" / MARKER).read_text() == (tmp_path / "out.csv").read_text() == "new"
    assert _names(tmp_path) == ["out", "out.csv"]


def test_a_folder_is_replaced_also_where_two_cannot_change_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    _make(tmp_path / "out", "old")
    with published(tmp_path / "out", overwrite=True) as path:
        _make(path, "new")
    assert _names(tmp_path) == ["out"] and (tmp_path / "out" / MARKER).read_text() == "new"


_KILLED_BETWEEN_RENAMES = """
import os, signal, sys
from pathlib import Path
from carts_core.files import MARKER, published, write_text
sys.platform, renames, rename = "darwin", [], os.rename
def rename_once(*names, **folders):
    if renames:
        os.kill(os.getpid(), signal.SIGKILL)
    renames.append(names)
    rename(*names, **folders)
os.rename = rename_once
with published(Path(sys.argv[1]), overwrite=True) as path:
    write_text(path / MARKER, "new")
"""


def test_what_a_kill_between_two_renames_took_away_comes_back(tmp_path: Path) -> None:
    _make(tmp_path / "out", "old")
    assert (
        subprocess.run([sys.executable, "-c", _KILLED_BETWEEN_RENAMES, tmp_path / "out"], check=False).returncode == -9
    )
    assert "out" not in _names(tmp_path)
    with pytest.raises(CartsError, match="out exists"), published(tmp_path / "out"):
        pass
    assert _names(tmp_path) == ["out"] and (tmp_path / "out" / MARKER).read_text() == "old"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_other_files_is_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years")
    with pytest.raises(CartsError, match="never replaced"), published(tmp_path / "home", overwrite=overwrite):
        pass
    assert _names(tmp_path / "home") == ["thesis.tex"] and _names(tmp_path) == ["home"]


def test_an_empty_folder_counts_as_absent(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with published(tmp_path / "out") as path:
        _make(path, "new")
    assert _names(tmp_path / "out") == [MARKER]


def test_what_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(CartsError, match="exists"), published(tmp_path / "out.csv") as path:
        write_text(path, "new")
        (tmp_path / "out.csv").write_text("somebody else's")
    assert (tmp_path / "out.csv").read_text() == "somebody else's" and _names(tmp_path) == ["out.csv"]


def test_a_disk_that_refuses_is_told_in_words(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CartsError, match="cannot be written"), published(tmp_path / "file" / "out"):
        pass
    with pytest.raises(CartsError, match="No space left on device"), published(tmp_path / "out") as path:
        _make(path, "new")
        raise OSError(28, "No space left on device")
    assert _names(tmp_path) == ["file"]


def test_two_exports_to_one_place_do_not_meet(tmp_path: Path) -> None:
    with published(tmp_path / "out") as path:
        with pytest.raises(CartsError, match=r"another export to .* is running"), published(tmp_path / "out"):
            pass
        _make(path, "first")
    assert (tmp_path / "out" / MARKER).read_text() == "first"


_KILLED = """
import sys, time
from pathlib import Path
from carts_core.files import MARKER, published, write_text
with published(Path(sys.argv[1]), overwrite=True) as path:
    write_text(path / MARKER, "half")
    print("writing", flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize("before", [None, "old"])
def test_a_kill_in_the_middle_changes_nothing_and_the_next_export_works(tmp_path: Path, before: str | None) -> None:
    target = tmp_path / "out"
    if before is not None:
        _make(target, before)
    with subprocess.Popen([sys.executable, "-c", _KILLED, target], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None and child.stdout.readline() == "writing\n"
        child.kill()
    assert target.exists() == (before is not None)
    assert before is None or (target / MARKER).read_text() == before
    with published(target, overwrite=True) as path:
        _make(path, "new")
    assert _names(tmp_path) == ["out"] and (target / MARKER).read_text() == "new"
