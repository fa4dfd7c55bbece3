"""Foreign recordings that are pipes, bombs or programs: refused in words, at once, with nothing written."""

import io
import os
import sqlite3
import zlib
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import recordings
from recordings import BagKind, write_bag
from scipy.io import savemat

from carts_core.decoders.tables import read_matlab
from carts_core.errors import SequenceError
from carts_core.files.decoding import decoded
from carts_core.files.reading import MIB
from carts_core.recording.image_sources import Bag
from carts_core.recording.importing.foreign_tables import read_array, read_foreign_table
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
    with pytest.raises(SequenceError, match=f"{file.name} is not read: it is no regular file"):
        Bag(bag)


def test_a_bag_whose_table_computes_without_end_is_refused(bag: Path) -> None:
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i AS id, i AS topic_id FROM n"
    with sqlite3.connect(database(bag)) as connection:
        connection.execute("ALTER TABLE messages RENAME TO others")
        connection.execute(f"CREATE VIEW messages AS {endless}")
    with pytest.raises(SequenceError, match="cannot be read"):
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


def test_a_bag_that_is_small_and_large_in_memory_is_refused(bag: Path) -> None:
    levels = "\n".join(f"a{n + 1}: &a{n + 1} {{<<: [{','.join([f'*a{n}'] * 9)}]}}" for n in range(9))
    (bag / "metadata.yaml").write_text(f"a0: &a0 {{k: 1}}\n{levels}\n{(bag / 'metadata.yaml').read_text()}")
    with pytest.raises(SequenceError, match=r"bag .* cannot be read \(decoding it (needs more|takes longer)"):
        Bag(bag)


def test_a_bag_that_expands_without_end_is_refused(bag: Path) -> None:
    from backports import zstd  # noqa: PLC0415

    compressor = zstd.ZstdCompressor()
    packed = [compressor.compress(bytes(MIB)) for _ in range(1200)]
    database(bag).with_suffix(".db3.zstd").write_bytes(b"".join([*packed, compressor.flush()]))
    text = (bag / "metadata.yaml").read_text().replace(database(bag).name, f"{database(bag).name}.zstd")
    text = text.replace("compression_format: ''", "compression_format: zstd")
    (bag / "metadata.yaml").write_text(text.replace("compression_mode: ''", "compression_mode: file"))
    with pytest.raises(SequenceError, match=r"bag .* cannot be read \((.*File too large|decoding it takes longer)"):
        Bag(bag)


def test_a_bag_on_its_own_is_checked_too(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.bag")
    with pytest.raises(SequenceError, match="no regular file"):
        Bag(tmp_path / "x.bag")


def npy(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue() + bytes(64)


def test_tables_that_expand_without_end_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(npy((10**12, 7)))
    np.savez_compressed(tmp_path / "b.npz", a=np.zeros(500 * MIB // 8))
    long = pyarrow.table({"yaw": pyarrow.array(np.zeros(20_000_000, np.int8))})
    pyarrow.parquet.write_table(long, tmp_path / "c.parquet", compression="zstd")
    (tmp_path / "d.csv").write_text("," * 3_000 + "\n" + "\n".join("0" for _ in range(4_000)))
    os.mkfifo(tmp_path / "e.parquet")
    for name, message in (
        ("a.npy", "needs more than"),
        ("b.npz", "needs more than"),
        ("c.parquet", "20,000,000 values"),
        ("d.csv", "values; at most 10,000,000"),
        ("e.parquet", "no regular file"),
    ):
        with pytest.raises(SequenceError, match=message):
            read_foreign_table(tmp_path / name)
    with pytest.raises(SequenceError, match="needs more than"):
        read_array(tmp_path / "a.npy")
    np.savez_compressed(tmp_path / "good.npz", a=np.arange(3.0), b=np.arange(3))
    assert read_foreign_table(tmp_path / "good.npz").numbers("a").tolist() == [0.0, 1.0, 2.0]


def test_matlab_files_that_expand_without_end_or_are_damaged_are_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "good.mat", {"K": np.eye(3)}, do_compression=True)
    assert np.array_equal(decoded(read_matlab, tmp_path / "good.mat")["K"], np.eye(3))
    bomb = zlib.compress((9).to_bytes(4, "little") + (480 * MIB).to_bytes(4, "little") + bytes(480 * MIB), 9)
    header = (tmp_path / "good.mat").read_bytes()[:128]
    tag = (15).to_bytes(4, "little") + len(bomb).to_bytes(4, "little")
    (tmp_path / "bomb.mat").write_bytes(header + tag + bomb)
    with pytest.raises(ValueError):
        decoded(read_matlab, tmp_path / "bomb.mat")
    (tmp_path / "torn.mat").write_bytes((tmp_path / "good.mat").read_bytes()[:-9])
    with pytest.raises(ValueError, match=r"no MATLAB file|damaged"):
        decoded(read_matlab, tmp_path / "torn.mat")
    (tmp_path / "hdf.mat").write_bytes(b"MATLAB 7.3 MAT-file" + bytes(105) + b"\x00\x02IM" + bytes(600))
    with pytest.raises(ValueError, match=r"version 7\.3; save it with"):
        decoded(read_matlab, tmp_path / "hdf.mat")


def test_joints_beyond_all_measure_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "joints_at", lambda time: np.full(6, 1e300))
    bag = write_bag(tmp_path / "bag", BagKind(frames=4))
    with pytest.raises(SequenceError):
        import_recording(bag, tmp_path / "out")
    assert not (tmp_path / "out").exists()
