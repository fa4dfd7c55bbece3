"""Randomly mutated and hostile recordings: imported, or refused with nothing written."""

import os
import random
import shutil
import sqlite3
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import recordings
from fuzz.growing_files import MCAP
from fuzz.mutations import mutated_bytes, mutated_text
from recordings import BagKind, write_bag
from scipy.io import savemat
from test_carts_layouts import ambf, cts, segstrong
from test_datasets import endovis, jigsaws, surgpose
from test_dvrk_recorder import session
from test_folder import lab
from test_lerobot import dataset
from test_surgsync import clip, episode

from carts_core.decoders.tables import read_matlab
from carts_core.errors import CartsError, SequenceError
from carts_core.files.decoding import Limits, decoded
from carts_core.recording import Sequence
from carts_core.recording.image_sources import Bag
from carts_core.recording.importing.importer import import_recording

MAKERS: dict[str, Callable[[Path], Path]] = {
    "ROS 1 bag": lambda folder: _bag(folder, "rec.bag", BagKind(ros=1, frames=3, endoscope="measured_cp")),
    "ROS 2 bag, sqlite3": lambda folder: _bag(folder, "bag", BagKind(frames=3, endoscope="measured_js")),
    "ROS 2 bag, MCAP": lambda folder: _bag(folder, "bag", BagKind(storage="mcap", frames=3)),
    "dVRK recorder": session,
    "LeRobot v2.1": partial(dataset, version="v2.1"),
    "LeRobot v3.0": partial(dataset, version="v3.0"),
    "SurgSync clip": clip,
    "SurgSync episode": episode,
    "CTS": cts,
    "AMBF": ambf,
    "SegSTRONG-C": segstrong,
    "SurgPose": surgpose,
    "EndoVis": endovis,
    "JIGSAWS": jigsaws,
    "folder": lab,
}
TEXTS = (".json", ".jsonl", ".yaml", ".yml", ".csv", ".txt", ".ini")
SAMPLED, WHOLE = 2, 60


def _bag(folder: Path, name: str, kind: BagKind) -> Path:
    folder.mkdir(parents=True)
    return write_bag(folder / name, kind)


def mutate(folder: Path, rng: random.Random) -> str:
    """Change or remove one file of a recording; returns a description of the change."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    # Tables and descriptions more often than the many images.
    others = [path for path in files if path.suffix not in (".png", ".jpg")]
    file = rng.choice(others if others and rng.random() < 0.8 else files)
    what = rng.choice(("bytes", "bytes", "text", "text", "text", "missing", "empty", "folder", "swapped"))
    content = file.read_bytes()
    if what == "missing":
        file.unlink()
    elif what == "folder":
        file.unlink()
        file.mkdir()
    elif what == "empty":
        file.write_bytes(b"")
    elif what == "swapped":
        file.write_bytes(rng.choice(files).read_bytes())
    elif what == "text" and file.suffix in TEXTS:
        file.write_bytes(mutated_text(content, rng))
    else:
        file.write_bytes(mutated_bytes(content, rng))
    return f"{what} {file.relative_to(folder)}"


def campaign(name: str, count: int, sandbox: Path) -> tuple[int, int]:
    """Import mutated recordings of one kind; returns the numbers of imported and refused recordings."""
    right = sandbox / "right"
    source = MAKERS[name](right / "source")
    imported = refused = 0
    for seed in range(count):
        work = sandbox / f"{seed}"
        shutil.copytree(right, work)
        done = mutate(work, random.Random(f"{name} {seed}"))
        before = sorted(work.rglob("*"))
        try:
            path, _ = import_recording(work / source.relative_to(right), work / "out")
        except CartsError as error:
            refused += 1
            assert len(str(error)) > 20, (name, seed, done)
            assert sorted(work.rglob("*")) == before, f"{name}, {seed} ({done}): something was written"
        except Exception as error:
            raise AssertionError(f"{name}, {seed} ({done}): {error!r}\n{traceback.format_exc()}") from error
        else:
            imported += 1
            assert len(Sequence.open(path)) > 0
        shutil.rmtree(work)
    print(f"{name}: {count} mutated, {imported} imported, {refused} refused in words")
    return imported, refused


@pytest.mark.parametrize("name", MAKERS)
def test_a_sample_of_mutated_recordings_is_imported_or_refused_in_words(name: str, tmp_path: Path) -> None:
    assert sum(campaign(name, SAMPLED, tmp_path)) == SAMPLED


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", MAKERS)
def test_60_mutated_recordings_of_each_source_are_imported_or_refused_in_words(name: str, tmp_path: Path) -> None:
    imported, refused = campaign(name, WHOLE, tmp_path)
    assert imported + refused == WHOLE and refused > 0


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag", BagKind(frames=2))


def database(bag: Path) -> Path:
    return next(bag.glob("*.db3"))


@pytest.mark.timeout(60)
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
def test_message_type_names_are_not_run(bag: Path, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with sqlite3.connect(database(bag)) as connection:
        connection.execute("UPDATE topics SET type = ?", (name,))
        connection.execute("UPDATE message_definitions SET topic_type = ?", (name,))
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("sensor_msgs/msg/JointState", repr(name)))
    with pytest.raises(SequenceError):
        Bag(bag)
    assert not Path("PWNED").exists()


@pytest.mark.timeout(60)
def test_a_bag_on_its_own_is_checked_too(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.bag")
    with pytest.raises(SequenceError, match="not a regular file"):
        Bag(tmp_path / "x.bag")


def test_a_bag_beyond_its_limits_is_not_called_damaged(tmp_path: Path) -> None:
    grown = MCAP["zstd"](tmp_path)
    with pytest.raises(SequenceError, match=r"needs more than 320 MiB of memory, the limit for .* split it") as refused:
        Bag(grown)
    assert "damaged" not in str(refused.value)


def test_a_bag_may_take_a_second_for_each_mebibyte(bag: Path) -> None:
    with Bag(bag) as reader:
        size = sum(file.stat().st_size for file in bag.iterdir())
        assert reader._limits.seconds == pytest.approx(Limits().seconds + size / 2**20)


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
