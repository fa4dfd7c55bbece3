"""Foreign recordings that are pipes, bombs or programs: refused in words, at once, with nothing written."""

import os
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import recordings
from recordings import BagKind, write_bag
from scipy.io import savemat

from carts_core.decoders.tables import read_matlab
from carts_core.errors import SequenceError
from carts_core.files.decoding import decoded
from carts_core.recording.image_sources import Bag
from carts_core.recording.importing.importer import import_recording

pytestmark = pytest.mark.timeout(60)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag", BagKind(frames=2))


def database(bag: Path) -> Path:
    return next(bag.glob("*.db3"))


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("place", ["database", "metadata"])
def test_a_bag_with_a_special_file_is_refused(bag: Path, kind: str, place: str) -> None:
    file = database(bag) if place == "database" else bag / "metadata.yaml"
    file.unlink()
    os.mkfifo(file) if kind == "pipe" else file.symlink_to("/dev/zero")
    with pytest.raises(SequenceError, match=f"{file.name} is not read: it is a pipe"):
        Bag(bag)


def test_the_log_beside_a_bag_is_neither_followed_nor_changed(bag: Path, tmp_path: Path) -> None:
    precious = tmp_path / "bashrc"
    precious.write_text("years of work")
    connection = sqlite3.connect(database(bag))
    connection.execute("PRAGMA journal_mode=WAL")
    connection.close()
    for suffix in ("-wal", "-shm", "-journal"):
        Path(f"{database(bag)}{suffix}").unlink(missing_ok=True)
        Path(f"{database(bag)}{suffix}").symlink_to(precious)
    before = sorted((path.name, path.lstat().st_mtime_ns) for path in bag.iterdir())
    with Bag(bag) as reader:
        assert reader.message(reader.topics[0][0]) is not None
    assert precious.read_text() == "years of work"
    assert sorted((path.name, path.lstat().st_mtime_ns) for path in bag.iterdir()) == before


@pytest.mark.parametrize("name", ["x/msg/Y:\n pass\nimport os\nos.mkdir('PWNED')\nclass Z", "a/msg/B'''+exit()+'''"])
def test_names_of_message_types_are_no_code(
    bag: Path, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with sqlite3.connect(database(bag)) as connection:
        connection.execute("UPDATE topics SET type = ?", (name,))
        connection.execute("UPDATE message_definitions SET topic_type = ?", (name,))
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("sensor_msgs/msg/JointState", repr(name)))
    with pytest.raises(SequenceError):
        Bag(bag)
    assert not Path("PWNED").exists()


def test_a_bag_on_its_own_is_checked_too(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.bag")
    with pytest.raises(SequenceError, match="not a regular file"):
        Bag(tmp_path / "x.bag")


def test_a_damaged_matlab_file_is_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "good.mat", {"K": np.eye(3)}, do_compression=True)
    assert np.array_equal(decoded(read_matlab, tmp_path / "good.mat")["K"], np.eye(3))
    (tmp_path / "torn.mat").write_bytes((tmp_path / "good.mat").read_bytes()[:-9])
    with pytest.raises(ValueError, match=r"not a MATLAB|damaged"):
        decoded(read_matlab, tmp_path / "torn.mat")


def test_joints_beyond_all_measure_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "joints_at", lambda time: np.full(6, 1e300))
    bag = write_bag(tmp_path / "bag", BagKind(frames=4))
    with pytest.raises(SequenceError):
        import_recording(bag, tmp_path / "out")
    assert not (tmp_path / "out").exists()
