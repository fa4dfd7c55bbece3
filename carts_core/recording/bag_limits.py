"""What a ROS bag may be: regular files, tables that are tables, and chunks that do not expand without end.

`rosbags` reads what it is given, so this is checked before it opens a bag, and its decompressors are replaced.
"""

import bz2
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO
from urllib.parse import quote

from ..errors import SequenceError
from ..files.reading import BAG, GIB, check_regular

LARGEST_CHUNK = GIB // 4
"""Of a compressed chunk or message, when it is expanded [bytes]."""
_LARGEST_RATIO = 100
"""How many times larger than itself a compressed file may become, beyond 1 GiB."""
_BLOCK = 2**20


def check_bag(path: Path) -> None:
    """See that a bag, a file or a folder, can be opened without harm.

    Raises:
        SequenceError: a file of it is a pipe or device, or a database with views or triggers.
    """
    files = [path] if not path.is_dir() else sorted(path.iterdir())
    for file in files:
        if path.is_dir() and file.is_dir():
            continue
        try:
            check_regular(file, BAG)
            if file.suffix == ".db3":
                _check_tables(file)
        except (OSError, ValueError) as error:
            raise SequenceError(f"bag {path}: {file.name} is not read ({error}). Copy the bag again.") from error


def limit_expansion() -> None:
    """Have `rosbags` give up where a chunk, a message or a file becomes far larger than it says."""
    from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415 - of an extra
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415
    from rosbags.rosbag2 import storage_mcap  # noqa: PLC0415

    first: Any = rosbag1.reader
    second: Any = rosbag2.reader
    if isinstance(second.shutil, SimpleNamespace):
        return
    zstd = second.zstd

    def from_lz4(data: bytes) -> bytes:
        return expanded(data, LZ4FrameDecompressor)

    def from_zstd(data: bytes) -> bytes:
        return expanded(data, zstd.ZstdDecompressor)

    first.decompressors["bz2"] = lambda data: expanded(data, bz2.BZ2Decompressor)
    first.decompressors["lz4"] = from_lz4
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, _: from_lz4(data)
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, _: from_zstd(data)
    second.zstd = SimpleNamespace(open=zstd.open, decompress=from_zstd)
    second.shutil = SimpleNamespace(copyfileobj=_copy)


def expanded(data: bytes, decompressor: Callable[[], Any], largest: int = LARGEST_CHUNK) -> bytes:
    """What was compressed.

    Raises:
        ValueError: it is cut off, or larger than allowed.
    """
    parts, length = [], 0
    while data:
        one = decompressor()
        parts.append(one.decompress(data, max_length=largest - length + 1))
        length += len(parts[-1])
        if length > largest:
            raise ValueError(f"a compressed chunk holds more than {largest // 2**20} MiB")
        if not one.eof:
            raise ValueError("a compressed chunk is cut off")
        data = one.unused_data
    return b"".join(parts)


def _copy(source: Any, target: BinaryIO) -> None:
    """As `shutil.copyfileobj`, of a file that is decompressed while it is read."""
    compressed = getattr(getattr(source, "_fp", None), "fileno", lambda: None)()
    size = 0 if compressed is None else os.fstat(compressed).st_size
    length = 0
    while block := source.read(_BLOCK):
        length += len(block)
        if length > GIB + _LARGEST_RATIO * size:
            raise ValueError(f"a compressed file of {size} bytes holds more than {length // 2**20} MiB")
        target.write(block)


def _check_tables(file: Path) -> None:
    """A view could compute without end when it is read, and a trigger has no place in a bag."""
    import apsw  # noqa: PLC0415 - of an extra

    try:
        # As `rosbags` opens it: nothing is written, and no log beside it is looked at.
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        with closing(apsw.Connection(f"file:{quote(str(file))}?immutable=1", flags=flags)) as database:
            found = "type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'"
            strange = [name for (name,) in database.execute(f"SELECT name FROM sqlite_master WHERE {found}")]
    except apsw.Error as error:
        raise ValueError(f"it is no SQLite database that can be read: {error}") from error
    if strange:
        raise ValueError(f"{strange[0]!r} in it is no table")
