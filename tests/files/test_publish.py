"""Published outputs and their staging folders: whole or absent, and foreign files beside them are kept."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from planted import contents, die, killed, treasure

from carts_core.errors import CartsError
from carts_core.files import MARKER, OutputPath, output_path, published, write_text


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


def test_what_a_kill_between_two_renames_took_away_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _make(tmp_path / "out", "old")
    rename = os.rename

    def replace_and_die() -> None:
        monkeypatch.setattr(sys, "platform", "darwin")
        monkeypatch.setattr(os, "rename", lambda *names, **folders: (rename(*names, **folders), die()))
        with published(tmp_path / "out", overwrite=True) as path:
            _make(path, "new")

    assert killed(replace_and_die) and "out" not in _names(tmp_path)
    with pytest.raises(CartsError, match="out exists"), published(tmp_path / "out"):
        pass
    assert _names(tmp_path) == ["out"] and (tmp_path / "out" / MARKER).read_text() == "old"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_other_files_is_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years")
    with (
        pytest.raises(CartsError, match="only folders written by an export"),
        published(tmp_path / "home", overwrite=overwrite),
    ):
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


def _kill(target: Path, key: str | None = None) -> Path:
    """What a killed process has left beside a target."""
    before = set(target.parent.iterdir())

    def write_half() -> None:
        with published(target, overwrite=key is None, key=key) as path:
            write_text(path / "half", "half")
            die()

    assert killed(write_half)
    (left,) = set(target.parent.iterdir()) - before
    return left


@pytest.mark.parametrize("before", [None, "old"])
def test_a_kill_in_the_middle_changes_nothing_and_the_next_export_works(tmp_path: Path, before: str | None) -> None:
    target = tmp_path / "out"
    if before is not None:
        _make(target, before)
    _kill(target)
    assert target.exists() == (before is not None)
    assert before is None or (target / MARKER).read_text() == before
    with published(target, overwrite=True) as path:
        _make(path, "new")
    assert _names(tmp_path) == ["out"] and (target / MARKER).read_text() == "new"


def test_what_was_planted_beside_an_output_stays(tmp_path: Path) -> None:
    """The former names, copies of a real staging folder, and links with such names."""
    home = treasure(tmp_path / "home")
    real = _kill(tmp_path / "out")
    shutil.copytree(real, tmp_path / f".carts-{'a' * 32}", symlinks=True)
    (tmp_path / f".carts-{'b' * 32}").symlink_to(home)
    (tmp_path / f".carts-{'c' * 32}").mkdir()
    forged = tmp_path / f".carts-{'c' * 32}" / "carts-unfinished.json"
    forged.write_text(json.dumps({"output": "out", "key": None, "inode": 1}))
    os.mkfifo(tmp_path / f".carts-{'d' * 32}")
    (tmp_path / f".carts-{'e' * 32}").mkdir()
    os.mkfifo(tmp_path / f".carts-{'e' * 32}" / "carts-unfinished.json")
    (tmp_path / ".out.part").symlink_to(home)
    (tmp_path / "out.part").mkdir()
    (tmp_path / "out.part" / "own").write_text("own")
    (tmp_path / "out.part" / "home").symlink_to(home)
    before = {name: what for name, what in contents(tmp_path).items() if not name.startswith(real.name)}
    with published(tmp_path / "out") as path:
        write_text(path / MARKER, "new")
    after = contents(tmp_path)
    assert {name: what for name, what in after.items() if not name.startswith("out")} == {
        name: what for name, what in before.items() if not name.startswith("out")
    }
    assert after["out.part/own"] == before["out.part/own"] and not real.exists()


def test_links_in_what_a_killed_process_left_are_removed_and_not_followed(tmp_path: Path) -> None:
    home = treasure(tmp_path / "home")
    before = contents(home)
    left = _kill(tmp_path / "out")
    (left / "out" / "home").symlink_to(home)
    with published(tmp_path / "out") as path:
        write_text(path / MARKER, "new")
    assert not left.exists() and contents(home) == before


def test_work_with_a_key_goes_on_where_it_was(tmp_path: Path) -> None:
    left = _kill(tmp_path / "out", "settings 1")
    with pytest.raises(KeyboardInterrupt), published(tmp_path / "out", key="settings 1") as path:
        assert (path / "half").path.read_text() == "half"
        raise KeyboardInterrupt
    assert left.exists()
    with published(tmp_path / "out", key="settings 1") as path:
        write_text(path / "other", "other half")
    assert sorted(os.listdir(tmp_path / "out")) == ["half", "other"] and os.listdir(tmp_path) == ["out"]


def test_work_with_another_key_begins_anew(tmp_path: Path) -> None:
    left = _kill(tmp_path / "out", "settings 1")
    with published(tmp_path / "out", key="settings 2") as path:
        assert not path.path.exists()
        write_text(path / "new", "new")
    assert not left.exists() and os.listdir(tmp_path / "out") == ["new"]


def test_an_output_that_is_a_link_is_refused(tmp_path: Path) -> None:
    home = treasure(tmp_path / "home")
    (tmp_path / "out").symlink_to(home / "thesis")
    with pytest.raises(CartsError, match="out is a link, which is never replaced"):
        with published(tmp_path / "out", overwrite=True):
            pass
    (home / "thesis" / MARKER).symlink_to(home / "bashrc")
    with (
        pytest.raises(CartsError, match="only folders written by an export"),
        published(home / "thesis", overwrite=True),
    ):
        pass


def test_everything_is_on_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced, replaced = [], []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (synced.append(os.readlink(f"/proc/self/fd/{file}")), fsync(file)))
    monkeypatch.setattr(os, "replace", lambda *a, **k: (replaced.append(len(synced)), replace(*a, **k)))
    with published(tmp_path / "out") as path:
        write_text(path / "masks" / "a.png", "a")
        write_text(path / MARKER, "b")
    before, after = synced[: replaced[0]], synced[replaced[0] :]
    assert [Path(name).name for name in before if not Path(name).is_dir()].count("a.png") == 1
    assert {"a.png", MARKER, "masks", "out"} <= {Path(name).name for name in before}
    assert after == [str(tmp_path)]
    synced.clear()
    write_text(output_path(tmp_path, "file"), "c")
    assert "deleted" in synced[0] or "file" in synced[0]
    assert synced[-1] == str(tmp_path)


def test_a_kill_at_any_moment_of_tidying_up_leaves_nothing_for_good(tmp_path: Path) -> None:
    unlink, rmdir = os.unlink, os.rmdir

    def replaced_until(steps: int) -> None:
        """Killed at this step of removing the old files."""
        done = iter(range(steps))
        with published(tmp_path / "out", overwrite=True) as path:
            for name in ("a", "z", MARKER):
                write_text(path / name, name)
            os.unlink = lambda *given, **named: die() if next(done, None) is None else unlink(*given, **named)
            os.rmdir = lambda *given, **named: die() if next(done, None) is None else rmdir(*given, **named)

    kills, was_killed = 0, True
    while was_killed:
        with published(tmp_path / "out", overwrite=True) as path:
            write_text(path / MARKER, "old")
        was_killed = killed(partial(replaced_until, kills))
        kills += was_killed
        assert (tmp_path / "out" / "z").read_text() == "z"
        with published(tmp_path / "out", overwrite=True) as path:
            write_text(path / MARKER, "new")
        assert os.listdir(tmp_path) == ["out"], kills
    # The old export's file and folder, the mark, and the staging folder.
    assert kills >= 4


def test_a_full_disk_leaves_no_staging_folder(tmp_path: Path) -> None:
    program = """
import resource, sys
from pathlib import Path
from carts_core.files import published
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
with published(Path(sys.argv[1])):
    pass
"""
    done = subprocess.run([sys.executable, "-c", program, tmp_path / "a"], capture_output=True, text=True, check=False)
    assert "OutputError" in done.stderr and "too large" in done.stderr
    assert list(tmp_path.iterdir()) == []
