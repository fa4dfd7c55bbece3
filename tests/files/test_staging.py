"""Staging folders: only those that we made are tidied up, whatever lies beside an output."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from planted import contents, treasure

from carts_core.errors import CartsError
from carts_core.files import MARKER, OutputPath, output_path, published, write_text

_KILLED = """
import os, signal, sys
from pathlib import Path
from carts_core.files import published, write_text
with published(Path(sys.argv[1]), key=sys.argv[2] or None) as path:
    write_text(path / "half", "half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def _kill(target: Path, key: str = "") -> Path:
    """What a killed process has left beside a target."""
    before = set(target.parent.iterdir())
    assert subprocess.run([sys.executable, "-c", _KILLED, target, key], check=False).returncode == -9
    (left,) = set(target.parent.iterdir()) - before
    return left


def test_names_are_random_and_hidden(tmp_path: Path) -> None:
    first, second = _kill(tmp_path / "a"), _kill(tmp_path / "b")
    assert first.name != second.name and first.name.startswith(".carts-") and len(first.name) == 39


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
    with pytest.raises(CartsError, match="never replaced"), published(home / "thesis", overwrite=True):
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


def test_a_draft_is_told_apart(tmp_path: Path) -> None:
    with published(tmp_path / "a") as path, published(tmp_path / "b", key="k") as resumable:
        assert isinstance(path, OutputPath) and path.draft and not resumable.draft
        write_text(path, "a")
        write_text(resumable, "b")


_KILLED_AT_REMOVAL = """
import os, signal, sys
from pathlib import Path
from carts_core.files import MARKER, published, write_text

steps = int(sys.argv[2])

def counted(step):
    def do(*arguments, **named):
        global steps
        if steps == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        steps -= 1
        return step(*arguments, **named)
    return do

with published(Path(sys.argv[1]), overwrite=True) as path:
    for name in ("a", "z", MARKER):
        write_text(path / name, name)
    os.unlink, os.rmdir = counted(os.unlink), counted(os.rmdir)
"""


def test_a_kill_at_any_moment_of_tidying_up_leaves_nothing_for_good(tmp_path: Path) -> None:
    kills, returned = 0, -9
    while returned == -9:
        with published(tmp_path / "out", overwrite=True) as path:
            write_text(path / MARKER, "old")
        command = [sys.executable, "-c", _KILLED_AT_REMOVAL, tmp_path / "out", str(kills)]
        returned = subprocess.run(command, check=False).returncode
        kills += returned == -9
        assert (tmp_path / "out" / "z").read_text() == "z"
        with published(tmp_path / "out", overwrite=True) as path:
            write_text(path / MARKER, "new")
        assert os.listdir(tmp_path) == ["out"], kills
    # The old export's file and folder, the mark, and the staging folder.
    assert returned == 0 and kills >= 4


def test_what_was_killed_while_it_was_marked_is_tidied_up(tmp_path: Path) -> None:
    left = tmp_path / f".carts-{'f' * 32}"
    left.mkdir()
    (left / "carts-unfinished.json").touch()
    with published(tmp_path / "out") as path:
        write_text(path / MARKER, "new")
    assert os.listdir(tmp_path) == ["out"]


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
