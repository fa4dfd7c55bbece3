"""Small files of all readable kinds that are large or slow for an unprotected decoder."""

import atexit
import base64
import io
import json
import shutil
import sqlite3
import struct
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow
import pyarrow.parquet
import scipy.sparse
from scipy.io import savemat

sys.path.append(str(Path(__file__).parent.parent / "recording" / "sources"))

from recordings import BagKind, write_bag  # pyright: ignore[reportMissingImports]

from carts_core.batch.folder import read_state
from carts_core.batch.manifest import read_manifest
from carts_core.cli.options import SolverOptions
from carts_core.errors import RobotError
from carts_core.files import output_path
from carts_core.files.decoding import decoded
from carts_core.files.reading import ROBOT, read_text
from carts_core.model.meshes import read_mesh
from carts_core.model.robot import parsed_urdf
from carts_core.model.xacro_guard import expanded
from carts_core.networks.weights import read_weights
from carts_core.project import Project
from carts_core.recording import Sequence
from carts_core.recording.annotations import read_annotations
from carts_core.recording.images import read_image
from carts_core.recording.importing.calibrations import read_calibration
from carts_core.recording.importing.foreign_tables import read_foreign_table
from carts_core.recording.importing.importer import find
from carts_core.recording.video import Video, index_video
from fuzz.kinds import make_folder

Maker = Callable[[Path], Path]
MIB = 2**20
_XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="x">'
_TRIANGLE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\n"


def _expanded(path: Path) -> object:
    try:
        return decoded(expanded, path, {}, {})
    except (OSError, ValueError) as error:
        raise RobotError(str(error)) from error


def _video(path: Path) -> object:
    count = index_video(path).count
    return [Video(path, (index,)).read(0).shape for index in range(min(count, 3))]


def _annotations(path: Path) -> object:
    sequence = Sequence.open(path.parent / "sequence.toml")
    return len(list(read_annotations(path, sequence, "left").frames))


def _onnx(path: Path) -> object:
    from carts_core.segmentation.onnx_segmenter import OnnxSegmenter  # noqa: PLC0415

    return OnnxSegmenter.load(path, path)


def _project(path: Path) -> object:
    return Project.open(Sequence.open(path.parent / "sequence.toml"), path, read_only=True)


READERS: dict[str, Callable[[Path], object]] = {
    **{kind: lambda path: read_calibration(path, "left") for kind in ("yaml", "ini", "mat", "json")},
    "toml": Sequence.open,
    "settings": lambda path: SolverOptions(settings=(str(path),)).printed(),
    "manifest": read_manifest,
    **dict.fromkeys(("csv", "parquet", "npy", "npz"), read_foreign_table),
    **dict.fromkeys(("bag", "mcap"), find),
    "kinematics": lambda path: Sequence.open(path.parent / "sequence.toml"),
    "video": _video,
    "image": read_image,
    "urdf": lambda path: parsed_urdf(read_text(path, ROBOT), path),
    "xacro": _expanded,
    **{kind: lambda path: read_mesh(path, np.ones(3), "a test") for kind in ("dae", "obj", "stl", "ply", "glb")},
    **dict.fromkeys(("coco", "cvat", "surgpose", "labelme", "label studio", "yolo"), _annotations),
    "safetensors": read_weights,
    "onnx": _onnx,
    "project": _project,
    "batch": lambda path: read_state(output_path(path.parent)),
}
"""Reads a file of a kind as the commands do."""


def _text(name: str, text: str | bytes | Callable[[], str | bytes]) -> Maker:
    """Writes a file of this content into the folder of right files."""

    def make(folder: Path) -> Path:
        content = text() if callable(text) else text
        _fill(folder)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        return folder / name

    return make


def _yolo(text: str | Callable[[], str]) -> Maker:
    """Writes a data set of YOLO with this content of a label file, or of the YAML file if it has `names`."""

    def make(folder: Path) -> Path:
        content = text() if callable(text) else text
        _fill(folder)
        (folder / "labels").mkdir()
        named = content.startswith("names")
        (folder / "data.yaml").write_text(content if named else "names: [a]")
        (folder / "labels" / "001.txt").write_text("0 0.1 0.1 0.9 0.1 0.9 0.9" if named else content)
        return folder / "data.yaml"

    return make


@cache
def right_folder() -> Path:
    """A folder with a right file of each kind."""
    folder = Path(tempfile.mkdtemp(prefix="carts-right-"))
    atexit.register(shutil.rmtree, folder)
    make_folder(folder / "files")
    return folder / "files"


def _fill(folder: Path) -> None:
    shutil.copytree(right_folder(), folder, dirs_exist_ok=True)


# -- text formats --------------------------------------------------------------------------------------------------

JSON = {
    "deep lists": lambda: "[" * 100_000 + "]" * 100_000,
    "empty lists": lambda: "[" + "[]," * 1_300_000 + "[]]",
    "long text": lambda: '"' + "a" * 4_000_000 + '"',
    "many keys": lambda: "{" + ",".join(f'"{n}":0' for n in range(300_000)) + "}",
    "long whole number": lambda: "1" * 4_000_000,
    "blanks": lambda: " " * 4_000_000 + "1",
}
TOML = {
    "deep lists": lambda: "a = " + "[" * 100_000 + "]" * 100_000,
    "long dotted key": lambda: ".".join(["a"] * 200_000) + " = 1",
    "many dotted keys": lambda: "\n".join(f"{'.'.join(['a'] * 31)}.b{n} = 1" for n in range(14_000)),
    "nested table headers": lambda: "\n".join(f"[{'.'.join(f'x{n}' for n in range(30))}.y{m}]" for m in range(7_000)),
    "long text": lambda: 'a = "' + "x" * 1_000_000 + '"',
    "long whole number": lambda: "a = " + "1" * 1_000_000,
    "empty lists": lambda: "a = [" + "[]," * 340_000 + "]",
    "many keys": lambda: "\n".join(f"a{n}=1" for n in range(100_000)),
}
_ALIASES = "\n".join(f"a{n + 1}: &a{n + 1} [{','.join([f'*a{n}'] * 9)}]" for n in range(9))
_MERGES = "\n".join(f"a{n + 1}: &a{n + 1} {{<<: [{','.join([f'*a{n}'] * 9)}]}}" for n in range(9))
YAML = {
    "aliases": lambda: f"a0: &a0 [1]\n{_ALIASES}",
    "merge keys": lambda: f"a0: &a0 {{k: 1}}\n{_MERGES}",
    "sexagesimal": lambda: "a: 1" + ":1" * 1_000_000,
    "long hexadecimal": lambda: "a: 0x" + "f" * 4_000_000,
    "long whole number": lambda: "a: " + "9" * 4_000_000,
    "deep lists": lambda: "[" * 1_000_000,
    "deep blocks": lambda: "\n".join(" " * n + "a:" for n in range(2_500)),
    "many values": lambda: "- 1\n" * 1_000_000,
    "long key": lambda: "? " + "k" * 4_000_000 + "\n: 1",
    "tags": lambda: "%TAG ! tag:a," + "b" * 3_000_000 + ":\n---\n" + "- !c 1\n" * 1000,
    "documents": lambda: "--- 1\n" * 600_000,
}
INI = {
    "interpolation": lambda: (
        "[StereoLeft]\nx0 = 1\n" + "".join(f"x{n + 1} = {f'%(x{n})s' * 8}\n" for n in range(30)) + "fc_x = %(x30)s\n"
    ),
    "blanks": lambda: "[StereoLeft]\nfc_x" + " " * 2_000_000 + "x",
    "many sections": lambda: "\n".join(f"[a{n}]" for n in range(300_000)),
    "continuation": lambda: "[a]\nk = 1\n" + " 1\n" * 1_000_000,
    "long number": lambda: "[StereoLeft]\nfc_x = " + "1" * 4_000_000 + "\n[StereoRight]\n",
}
_URDF_HEAD = '<robot name="a"><link name="base"/>'
URDF = {
    "entities": lambda: '<!DOCTYPE r [<!ENTITY a "aa">]><robot name="&a;"/>',
    "deep": lambda: '<robot name="a">' + "<link>" * 500_000,
    "many elements": lambda: _URDF_HEAD + "<a/>" * 3_500_000 + "</robot>",
    "many attributes": lambda: "<robot " + " ".join(f'a{n}=""' for n in range(700_000)) + "/>",
    "long text": lambda: "<robot name='a'>" + "x" * 15_000_000 + "</robot>",
    "many joints": lambda: _URDF_HEAD + '<joint name="j"/>' * 700_000 + "</robot>",
    "chain": lambda: (
        '<robot name="a">'
        + "".join(f'<link name="l{n}"/>' for n in range(1000))
        + "".join(
            f'<joint name="j{n}" type="revolute"><parent link="l{n}"/><child link="l{n + 1}"/>'
            f'<mimic joint="j{n + 1 if n < 998 else 0}"/></joint>'
            for n in range(999)
        )
        + "</robot>"
    ),
}
_DOUBLED = "".join(f'<xacro:macro name="m{n + 1}"><xacro:m{n}/><xacro:m{n}/></xacro:macro>' for n in range(40))
XACRO = {
    "macros": lambda: f'<xacro:macro name="m0"><link name="a"/></xacro:macro>{_DOUBLED}<xacro:m40/>',
    "endless macro": lambda: '<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>',
    "properties": lambda: (
        '<xacro:property name="p0" value="aa"/>'
        + "".join(f'<xacro:property name="p{n + 1}" value="${{p{n}}}${{p{n}}}"/>' for n in range(40))
        + '<link name="${p40}"/>'
    ),
    "endless property": lambda: '<xacro:property name="p" value="${p}${p}"/><link name="${p}"/>',
    "long expression": lambda: f'<link name="${{{"1+" * 1_000_000}1}}"/>',
    "power": lambda: '<link name="${10 ** 10 ** 10}"/>',
    "yaml": lambda: "<link name=\"${xacro.load_yaml('/dev/zero')}\"/>",
    "conditions": lambda: "<xacro:if value='1'>" * 5_000 + "</xacro:if>" * 5_000,
}
CSV = {
    "long cell": lambda: "yaw\n" + "1\n" * 100_000 + "9" * 1_000_000,
    "many columns": lambda: ",".join(f"c{n}" for n in range(400_000)) + "\n" + ",".join(["1"] * 400_000),
    "many rows": lambda: "yaw\n" + "1\n" * 2_000_000,
    "open quote": lambda: 'yaw,a\n"' + "x,\n" * 1_000_000,
    "long name": lambda: "y" * 4_000_000 + ",a\n1,2\n",
    "long number": lambda: "yaw,a\n" + "1" * 2_000_000 + ",1\n",
}


# -- tables and arrays ---------------------------------------------------------------------------------------------


def _parquet(make: Callable[[], Any], **options: Any) -> Maker:
    def write(folder: Path) -> Path:
        pyarrow.parquet.write_table(make(), folder / "a.parquet", **options)
        return folder / "a.parquet"

    return write


def _dictionary(texts: int, length: int, rows: int) -> Any:
    values = pyarrow.array([f"{number}{'x' * length}" for number in range(texts)])
    places = pyarrow.array(np.arange(rows, dtype=np.int32) % texts)
    return pyarrow.table({"yaw": pyarrow.DictionaryArray.from_arrays(places, values)})


def _nested(depth: int) -> Any:
    kind: Any = pyarrow.int8()
    value: Any = 1
    for _ in range(depth):
        kind, value = pyarrow.list_(kind), [value]
    return pyarrow.table({"yaw": pyarrow.array([value] * 10, kind)})


PARQUET: dict[str, Maker] = {
    "dictionary of texts": _parquet(lambda: _dictionary(300, 5_000, 1_000_000)),
    "equal numbers": _parquet(lambda: pyarrow.table({"yaw": np.zeros(9_900_000)}), compression="zstd"),
    "too many numbers": _parquet(lambda: pyarrow.table({"yaw": np.zeros(12_000_000, np.int8)}), compression="zstd"),
    "many columns": _parquet(lambda: pyarrow.table({f"c{n}": [0] for n in range(5_000)})),
    "deep lists": _parquet(lambda: _nested(60)),
    "lists of texts": _parquet(
        lambda: pyarrow.table({"yaw": pyarrow.array([["x" * 1000] * 2 + ["y" * 100_000]] * 2_000)}), compression="zstd"
    ),
    "structs": _parquet(
        lambda: pyarrow.table({"yaw": pyarrow.array([{"a": {"b": {"c": "x" * 100}}}] * 300_000)}), compression="zstd"
    ),
    "nothing": _parquet(lambda: pyarrow.table({"yaw": pyarrow.nulls(5_000_000)})),
}


def _npy(head: str | dict[str, Any], body: bytes = bytes(64), version: int = 1) -> bytes:
    text = (head if isinstance(head, str) else repr(head)).encode() + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text + body


def _shaped(shape: tuple[int, ...], descr: Any = "<f8", **options: Any) -> dict[str, Any]:
    return {"descr": descr, "fortran_order": False, "shape": shape, **options}


NPY = {
    "false length": lambda: _npy(_shaped((10**12,))),
    "false shape": lambda: _npy(_shaped((10**9, 10**9))),
    "no size": lambda: _npy(_shaped((10**12,), "|V0")),
    "wide text": lambda: _npy(_shaped((10,), "<U500000000")),
    "deep header": lambda: _npy("(" * 9_000),
    "objects": lambda: _npy(_shaped((10,), "|O")),
    "mebibytes": lambda: _npy(_shaped((40 * MIB,), "|i1"), bytes(40 * MIB)),
}


def _zip(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED, size: int | None = None) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    content = bytearray(stream.getvalue())
    if size is not None:
        place = content.rindex(b"PK\x01\x02") + 24
        content[place : place + 4] = size.to_bytes(4, "little")
    return bytes(content)


def _zeros(mebibytes: int) -> bytes:
    return _npy(_shaped((mebibytes * MIB,), "|i1"), bytes(mebibytes * MIB))


NPZ = {
    "expands": lambda: _zip({"a.npy": _zeros(1_000)}),
    "false small size": lambda: _zip({"a.npy": _zeros(1_000)}, size=8),
    "false large size": lambda: _zip({"a.npy": _zeros(1)}, size=2**32 - 2),
    "many members": lambda: _zip({f"a{n}.npy": _zeros(0) for n in range(30_000)}),
    "no array": lambda: _zip({"a.txt": bytes(800 * MIB)}),
}


def _mat(*elements: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def _element(kind: int, content: bytes, length: int | None = None) -> bytes:
    data = struct.pack("<II", kind, len(content) if length is None else length) + content
    return data + bytes(-len(data) % 8)


def _matrix(shape: tuple[int, ...], content: bytes, kind: int = 6) -> bytes:
    head = _element(6, struct.pack("<II", kind, 0)) + _element(5, struct.pack(f"<{len(shape)}i", *shape))
    return _element(14, head + _element(1, b"a") + content)


def _cells(depth: int) -> bytes:
    inner = _matrix((1, 1), _element(9, struct.pack("<d", 1.0)))
    for _ in range(depth):
        inner = _matrix((1, 1), inner, 1)
    return inner


def _saved(**values: Any) -> Callable[[], bytes]:
    def make() -> bytes:
        stream = io.BytesIO()
        savemat(stream, values, do_compression=True)
        return stream.getvalue()

    return make


MAT = {
    "expands": _saved(K=np.zeros(120 * MIB)),
    "bomb": lambda: _mat(_element(15, zlib.compress(_element(14, bytes(900 * MIB)), 1))),
    "false shape": lambda: _mat(_matrix((30_000, 30_000), _element(9, bytes(64)))),
    "deep cells": lambda: _mat(_cells(3_000)),
    "many cells": _saved(K=np.array([[n] for n in range(200_000)], object)),
    "false length": lambda: _mat(_element(14, bytes(64), 2**31 - 1)),
    "sparse": _saved(K=scipy.sparse.csc_matrix((1, 50_000_000))),
}

# -- bags and MCAP files -------------------------------------------------------------------------------------------


_SMALL_BAG = BagKind(frames=2)


def _bag(change: Callable[[Path], None], kind: BagKind = _SMALL_BAG) -> Maker:
    def make(folder: Path) -> Path:
        write_bag(folder / "bag", kind)
        change(folder / "bag")
        return folder / "bag"

    return make


def _metadata(text: Callable[[str], str]) -> Maker:
    def change(bag: Path) -> None:
        (bag / "metadata.yaml").write_text(text((bag / "metadata.yaml").read_text()))

    return _bag(change)


def _database(*statements: str) -> Maker:
    def change(bag: Path) -> None:
        with sqlite3.connect(next(bag.glob("*.db3"))) as connection:
            for statement in statements:
                connection.execute(statement)

    return _bag(change)


def _packed_bag(bag: Path) -> None:
    from backports import zstd  # noqa: PLC0415

    database = next(bag.glob("*.db3"))
    compressor = zstd.ZstdCompressor()
    content = b"".join([*(compressor.compress(bytes(MIB)) for _ in range(1200)), compressor.flush()])
    database.with_suffix(".db3.zstd").write_bytes(content)
    text = (bag / "metadata.yaml").read_text().replace(database.name, f"{database.name}.zstd")
    text = text.replace("compression_format: ''", "compression_format: zstd")
    (bag / "metadata.yaml").write_text(text.replace("compression_mode: ''", "compression_mode: file"))


def _packed_messages(bag: Path) -> None:
    from backports import zstd  # noqa: PLC0415

    with sqlite3.connect(next(bag.glob("*.db3"))) as connection:
        connection.execute("UPDATE messages SET data = ?", (zstd.compress(bytes(900 * MIB)),))
    text = (bag / "metadata.yaml").read_text().replace("compression_format: ''", "compression_format: zstd")
    (bag / "metadata.yaml").write_text(text.replace("compression_mode: ''", "compression_mode: message"))


BAG: dict[str, Maker] = {
    "merge keys": _metadata(lambda text: f"a0: &a0 {{k: 1}}\n{_MERGES}\n{text}"),
    "long metadata": _metadata(lambda text: "a: [" + "1, " * 700_000 + f"]\n{text}"),
    "file of zeros": _bag(_packed_bag),
    "messages of zeros": _bag(_packed_messages),
    "many topics": _database(
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 30000) INSERT INTO topics "
        "SELECT i + 1000, '/a' || i, 'std_msgs/msg/String', 'cdr', '', '' FROM n"
    ),
    "endless view": _database(
        "ALTER TABLE messages RENAME TO others",
        "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) "
        "SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(100) AS data FROM n",
    ),
    "messages of a gigabyte": _database("UPDATE messages SET data = zeroblob(900000000) WHERE id < 3"),
    "false counts": _database("UPDATE messages SET data = x'00010000ffffff7fffffff7fffffff7f' || zeroblob(40)"),
    "nested definition": _database(
        "UPDATE message_definitions SET encoded_message_definition = 'a/B[1000000000] header\n" + "=" * 80 + "\n"
        "MSG: a/B\na/C[1000000000] c\n" + "=" * 80 + "\nMSG: a/C\nuint8[1000000000] d\n'"
    ),
}


def _record(code: int, content: bytes) -> bytes:
    return bytes([code]) + struct.pack("<Q", len(content)) + content


def _mcap_text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _mcap(*records: bytes) -> bytes:
    magic = b"\x89MCAP0\r\n"
    head = _record(1, _mcap_text("ros2") + _mcap_text("x"))
    return magic + head + b"".join(records) + _record(2, bytes(20)) + magic


def _chunk(name: str, content: bytes, size: int) -> bytes:
    head = struct.pack("<QQQI", 0, 1, size, 0) + _mcap_text(name)
    return _record(6, head + struct.pack("<Q", len(content)) + content)


def _lz4(size: int) -> bytes:
    from lz4.frame import compress  # noqa: PLC0415

    return compress(bytes(size))


def _zstd(size: int) -> bytes:
    from backports import zstd  # noqa: PLC0415

    return zstd.compress(bytes(size))


def _damaged_mcap(change: Callable[[bytes], bytes]) -> Maker:
    def make(folder: Path) -> Path:
        write_bag(folder / "bag", BagKind(frames=2, storage="mcap"))
        path = folder / "a.mcap"
        path.write_bytes(change(next((folder / "bag").glob("*.mcap")).read_bytes()))
        return path

    return make


MCAP: dict[str, Maker] = {
    "zstd": _text("a.mcap", lambda: _mcap(_chunk("zstd", _zstd(900 * MIB), 900 * MIB))),
    "lz4": _text("a.mcap", lambda: _mcap(_chunk("lz4", _lz4(900 * MIB), 900 * MIB))),
    "false size": _text("a.mcap", lambda: _mcap(_chunk("zstd", _zstd(900 * MIB), 8))),
    "false large size": _text("a.mcap", lambda: _mcap(_chunk("", bytes(64), 2**62))),
    "many chunks": _text("a.mcap", lambda: _mcap(*[_chunk("zstd", _zstd(20 * MIB), 20 * MIB) for _ in range(100)])),
    "end first": _damaged_mcap(lambda data: data[:-8] + struct.pack("<Q", 2**60)),
    "no summary": _damaged_mcap(lambda data: data[:-37] + bytes(20) + data[-17:]),
}


# -- videos and images ---------------------------------------------------------------------------------------------


def _box(video: bytes, name: bytes, change: Callable[[bytearray, int], None]) -> bytes:
    content = bytearray(video)
    place = content.find(name)
    while place >= 0:
        change(content, place + 4)
        place = content.find(name, place + 4)
    return bytes(content)


def _put(offset: int, *numbers: int) -> Callable[[bytearray, int], None]:
    def change(content: bytearray, place: int) -> None:
        content[place + offset : place + offset + 4 * len(numbers)] = struct.pack(f">{len(numbers)}I", *numbers)

    return change


def _mp4(name: bytes, change: Callable[[bytearray, int], None]) -> Maker:
    def make(folder: Path) -> Path:
        _fill(folder)
        path = folder / "video.mp4"
        path.write_bytes(_box(path.read_bytes(), name, change))
        return path

    return make


VIDEO: dict[str, Maker] = {
    "equal sizes": _mp4(b"stsz", _put(4, 8, 2**28)),
    "many samples": _mp4(b"stsz", _put(8, 2**30)),
    "long time table": _mp4(b"stts", _put(4, 1, 2**31 - 1, 1)),
    "many time entries": _mp4(b"stts", _put(4, 2**30)),
    "chunk offsets": _mp4(b"stco", _put(4, 2**30)),
    "time scale": _mp4(b"mdhd", _put(12, 1)),
    "wide": _mp4(b"avc1", _put(24, (16_000 << 16) + 16_000)),
    "movie length": _mp4(b"mvhd", _put(12, 1, 2**32 - 1)),
}


def _chunk_png(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def _png(width: int, height: int, rows: bytes, *chunks: bytes, depth: int = 8, color: int = 0, lace: int = 0) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, lace)
    packed = zlib.compress(rows, 9)
    return (
        b"\x89PNG\r\n\x1a\n"
        + _chunk_png(b"IHDR", head)
        + b"".join(chunks)
        + _chunk_png(b"IDAT", packed)
        + (_chunk_png(b"IEND", b""))
    )


def _scans(side: int, count: int) -> bytes:
    """A progressive JPEG of many refining scans, all of them empty."""
    ok, data = cv2.imencode(
        ".jpg", np.full((side, side), 127, np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 50]
    )
    assert ok
    content = data.tobytes()
    end = content.rindex(b"\xff\xd9")
    last = content.rindex(b"\xff\xda")
    return content[:end] + content[last:end] * count + content[end:]


def _tiff(width: int, height: int, **tags: int) -> bytes:
    entries = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: 64}
    entries |= {int(key[1:]): value for key, value in tags.items()}
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(entries.items()))
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + body + bytes(200)


IMAGE: dict[str, Maker] = {
    "zeros": _text("a.png", lambda: _png(6_000, 6_000, bytes(6_001 * 6_000))),
    "too large": _text("a.png", lambda: _png(60_000, 60_000, bytes(1000))),
    "rows of zeros": _text("a.png", lambda: _png(64, 48, bytes(900 * MIB))),
    "text": _text(
        "a.png", lambda: _png(64, 48, bytes(65 * 48), _chunk_png(b"zTXt", b"a\0\0" + zlib.compress(bytes(900 * MIB))))
    ),
    "many chunks": _text("a.png", lambda: _png(64, 48, bytes(65 * 48), _chunk_png(b"tEXt", b"a\0b") * 200_000)),
    "scans": _text("a.jpg", lambda: _scans(6_000, 400)),
    "large tiff": _text("a.tiff", lambda: _tiff(2**31, 2**31)),
    "tiles": _text("a.tiff", lambda: _tiff(64, 48, t322=2**20, t323=2**20, t324=8, t325=64)),
}


# -- meshes --------------------------------------------------------------------------------------------------------

_DAE = (
    '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>{more}'
    '<library_geometries><geometry id="g"><mesh>'
    '<source id="p"><float_array id="f" count="9">{numbers}</float_array><technique_common>'
    '<accessor source="#f" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
    '<param name="Z" type="float"/></accessor></technique_common></source>'
    '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
    '<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>{places}</p></triangles>'
    "</mesh></geometry></library_geometries>{nodes}"
    '<library_visual_scenes><visual_scene id="s">{scene}</visual_scene></library_visual_scenes>'
    '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
)


def _dae(**parts: str) -> str:
    values = {"more": "", "numbers": "0 0 0 0.1 0 0 0 0.1 0", "places": "0 1 2", "nodes": ""}
    values["scene"] = '<node id="n"><instance_geometry url="#g"/></node>'
    return _DAE.format(**(values | parts))


def _instances(levels: int, each: int) -> str:
    nodes = '<node id="n0"><instance_geometry url="#g"/></node>'
    for level in range(1, levels + 1):
        inner = f'<instance_node url="#n{level - 1}"/>' * each
        nodes += f'<node id="n{level}">{inner}</node>'
    return nodes


def _nodes(count: int) -> str:
    return "".join(f'<node id="a{n}"><instance_geometry url="#g"/></node>' for n in range(count))


DAE = {
    "instances": lambda: _dae(
        nodes=f"<library_nodes>{_instances(10, 8)}</library_nodes>",
        scene='<node id="x"><instance_node url="#n10"/></node>',
    ),
    "instances of itself": lambda: _dae(
        nodes='<library_nodes><node id="a"><instance_node url="#a"/><instance_node url="#a"/></node></library_nodes>',
        scene='<node id="x"><instance_node url="#a"/></node>',
    ),
    "many nodes": lambda: _dae(scene=_nodes(60_000)),
    "deep nodes": lambda: _dae(scene='<node id="a">' * 5_000 + "</node>" * 5_000),
    "many numbers": lambda: _dae(numbers="0.5 " * 1_000_000),
    "large place": lambda: _dae(places="0 1 2000000000"),
    "entities": lambda: (
        '<!DOCTYPE a [<!ENTITY a0 "aaaaaaaaaa">'
        + "".join(f'<!ENTITY a{n + 1} "{f"&a{n};" * 10}">' for n in range(9))
        + f"]>{_dae(more='<extra>&a9;</extra>')}"
    ),
    "many elements": lambda: _dae(more="<extra/>" * 500_000),
}
OBJ = {
    "large place": lambda: f"{_TRIANGLE}f 1 2 2000000000\n",
    "one large face": lambda: _TRIANGLE + "f " + "1 2 3 " * 300_000,
    "many faces": lambda: _TRIANGLE + "f 1 2 3\n" * 400_000,
    "long number": lambda: "v " + "1" * 4_000_000 + " 0 0\nf 1 1 1\n",
    "many objects": lambda: _TRIANGLE + "".join(f"o a{n}\nf 1 2 3\n" for n in range(100_000)),
}


def _stl(count: int, body: bytes) -> bytes:
    return bytes(80) + struct.pack("<I", count) + body


_ASCII_STL = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
STL = {
    "false count": lambda: _stl(2**32 - 1, bytes(50)),
    "many faces": lambda: _stl(1_100_000, bytes(50 * 1_100_000)),
    "text": lambda: "solid a\n" + _ASCII_STL * 40_000 + "endsolid",
    "many solids": lambda: f"solid a\n{_ASCII_STL}endsolid\n" * 20_000,
}


def _ply(elements: str, body: bytes | str = b"", form: str = "binary_little_endian") -> bytes:
    data = body if isinstance(body, bytes) else body.encode()
    return f"ply\nformat {form} 1.0\n{elements}\nend_header\n".encode() + data


_XYZ = "property float x\nproperty float y\nproperty float z"
PLY = {
    "false count": lambda: _ply(f"element vertex 2000000000\n{_XYZ}", bytes(120)),
    "long list": lambda: _ply(
        f"element vertex 3\n{_XYZ}\nelement face 1\nproperty list uint int vertex_indices",
        bytes(36) + b"\xff\xff\xff\x7f" + bytes(64),
    ),
    "empty rows": lambda: _ply(f"element vertex 3\n{_XYZ}\nelement a 2000000000", bytes(36)),
    "many properties": lambda: _ply("element vertex 1\n" + "\n".join(f"property float a{n}" for n in range(60_000))),
    "text": lambda: _ply(
        f"element vertex 3\n{_XYZ}\nelement face 300000\nproperty list uchar int vertex_indices",
        "0 0 0\n1 0 0\n0 1 0\n" + "3 0 1 2\n" * 300_000,
        "ascii",
    ),
    "texture": lambda: _ply(
        f"comment TextureFile zeros.png\nelement vertex 3\n{_XYZ}\nproperty float s\nproperty float t\n"
        "element face 1\nproperty list uchar int vertex_indices",
        struct.pack("<15f", *[0.0] * 15) + b"\x03" + struct.pack("<3i", 0, 1, 2),
    ),
}


def _glb(tree: dict[str, Any] | bytes, data: bytes = b"") -> bytes:
    text = tree if isinstance(tree, bytes) else json.dumps({"asset": {"version": "2.0"}, **tree}).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _gltf(**changes: Any) -> dict[str, Any]:
    tree: dict[str, Any] = {
        "buffers": [{"byteLength": 48}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    return tree | changes


_BIN = struct.pack("<9f3I", 0, 0, 0, 0.1, 0, 0, 0, 0.1, 0, 0, 1, 2)


def _large_accessor(count: int, view: bool) -> dict[str, Any]:
    tree = _gltf()
    tree["accessors"][0] = {"componentType": 5126, "count": count, "type": "VEC3"} | ({"bufferView": 0} if view else {})
    return tree


GLB = {
    "zeros": lambda: _glb(_large_accessor(2_000_000_000, False), _BIN),
    "false count": lambda: _glb(_large_accessor(2_000_000_000, True), _BIN),
    "instances": lambda: _glb(
        _gltf(nodes=[{"mesh": 0}, *({"children": [n] * 10} for n in range(9))], scenes=[{"nodes": [9]}]), _BIN
    ),
    "many nodes": lambda: _glb(_gltf(nodes=[{"mesh": 0}] * 60_000, scenes=[{"nodes": list(range(60_000))}]), _BIN),
    "deep nodes": lambda: _glb(_gltf(nodes=[{"children": [n + 1]} for n in range(20_000)] + [{"mesh": 0}]), _BIN),
    "many primitives": lambda: _glb(
        _gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * 60_000}]), _BIN
    ),
    "deep tree": lambda: _glb(b"[" * 1_000_000),
    "false length": lambda: struct.pack("<4sIII4s", b"glTF", 2, 2**32 - 1, 2**32 - 1, b"JSON") + b"{}",
}


# -- annotations, networks, projects -------------------------------------------------------------------------------


def _coco(**changes: Any) -> str:
    content: dict[str, Any] = {
        "images": [{"id": 7, "file_name": "left/001.png", "width": 64, "height": 48}],
        "categories": [{"id": 3, "name": "grasper"}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 3, "segmentation": [[10, 10, 30, 10, 30, 20]]}],
    }
    return json.dumps(content | changes)


def _marked(segmentation: Any, times: int = 1, **image: Any) -> str:
    mark = {"id": 1, "image_id": 7, "category_id": 3, "segmentation": segmentation}
    images = [{"id": 7, "file_name": "left/001.png", "width": 64, "height": 48, **image}]
    return _coco(annotations=[mark] * times, images=images)


COCO = {
    "huge image": lambda: _marked([[0, 0, 9e8, 0, 9e8, 9e8]], width=10**9, height=10**9),
    "huge runs": lambda: _marked({"counts": [0, 10**18], "size": [10**9, 10**9]}),
    "long runs": lambda: _marked({"counts": "1" * 4_000_000, "size": [48, 64]}),
    "large polygon": lambda: _marked([[1, 2] * 400_000]),
    "many polygons": lambda: _marked([[1, 1, 60, 1, 60, 40]] * 60_000),
    "many marks": lambda: _marked([[1, 1, 60, 1, 60, 40]], 20_000),
    "large images": lambda: _marked(
        {"counts": [0, 40_000_000], "size": [5_000, 8_000]}, 300, width=8_000, height=5_000
    ),
}
_CVAT_HEAD = '<?xml version="1.0"?><annotations><version>1.1</version>'


def _cvat(shapes: str, width: int = 64, height: int = 48) -> str:
    size = f'width="{width}" height="{height}"'
    return f'{_CVAT_HEAD}<image id="0" name="left_001.png" {size}>{shapes}</image></annotations>'


CVAT = {
    "entities": lambda: f'<!DOCTYPE a [<!ENTITY a "aa">]>{_cvat("&a;")}',
    "many elements": lambda: _cvat("<a/>" * 1_000_000),
    "many polygons": lambda: _cvat('<polygon label="a" points="1,1;60,1;60,40"/>' * 60_000),
    "huge mask": lambda: _cvat(
        '<mask label="a" rle="0, 999999999999" left="0" top="0" width="1000000" height="1000000"/>'
    ),
    "huge image": lambda: _cvat('<polygon label="a" points="0,0;1000000000,0;0,1000000000"/>', 10**9, 10**9),
}
SURGPOSE = {
    "aliases": lambda: f"a0: &a0 [1]\n{_ALIASES}",
    "too many frames": lambda: "\n".join(f"{n}: {{1: [1, 2]}}" for n in range(300_000)),
    "many keypoints": lambda: "0: {" + ", ".join(f"{n}: [1, 2]" for n in range(100_000)) + "}",
}


def _labelme(*shapes: dict[str, Any], times: int = 1, **changes: Any) -> str:
    head = {"version": "5.5.0", "flags": {}, "imagePath": "001.png", "imageData": None}
    return json.dumps(head | {"imageHeight": 48, "imageWidth": 64, "shapes": [*shapes] * times} | changes)


def _png_text(side: int) -> str:
    content = cv2.imencode(".png", np.zeros((side, side), np.uint8))[1].tobytes()
    return base64.b64encode(content).decode()


_TRIANGLE_SHAPE = {"label": "a", "shape_type": "polygon", "points": [[1, 1], [60, 1], [60, 40]]}
LABELME = {
    "huge image": lambda: _labelme(_TRIANGLE_SHAPE, imageHeight=10**9, imageWidth=10**9),
    "many shapes": lambda: _labelme(_TRIANGLE_SHAPE, times=60_000),
    "large polygon": lambda: _labelme({"label": "a", "points": [[1, 2], [50, 40]] * 200_000}),
    "large mask": lambda: _labelme(
        {"label": "a", "shape_type": "mask", "points": [[0, 0], [5999, 5999]], "mask": _png_text(6000)}, times=200
    ),
    "large circles": lambda: _labelme(
        {"label": "a", "shape_type": "circle", "points": [[30, 30], [30_000, 30]]}, times=5_000
    ),
    "large picture": lambda: _labelme(_TRIANGLE_SHAPE, imageData="A" * 4_000_000),
}


def _studio(value: dict[str, Any], times: int = 1, **region: Any) -> str:
    one = {"original_width": 64, "original_height": 48, "to_name": "image", "type": "brushlabels", "value": value}
    return json.dumps([{"data": {"image": "001.png"}, "annotations": [{"result": [one | region] * times}]}])


_HEAD = [0, 0, 48, 0, 0x38 | 0x1, 0x1B, 0xF8 | 0x7]
"""Beginning of the run lengths of 48 x 64 pixels."""
LABEL_STUDIO = {
    "huge count": lambda: _studio({"rle": [255] * 2_000}, original_width=10**6, original_height=1000),
    "false count": lambda: _studio({"rle": [255] * 1_000_000}),
    "long runs": lambda: _studio({"rle": [*_HEAD, *[0] * 1_000_000]}),
    "many regions": lambda: _studio({"points": [[1, 1], [90, 1], [90, 90]]}, times=20_000),
    "many tasks": lambda: json.dumps([{"data": {"image": "001.png"}, "annotations": []}] * 200_000),
    "large ellipses": lambda: _studio({"x": 50, "y": 50, "radiusX": 4000, "radiusY": 4000}, times=5_000),
}
YOLO = {
    "many lines": lambda: "0 0.1 0.1 0.9 0.1 0.9 0.9\n" * 60_000,
    "large polygon": lambda: "0 " + "0.1 0.2 " * 400_000,
    "many names": lambda: "names: [" + "a, " * 200_000 + "a]",
}


def _tensors(header: str | dict[str, Any], length: int | None = None, body: bytes = bytes(64)) -> bytes:
    text = (header if isinstance(header, str) else json.dumps(header)).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + body


SAFETENSORS = {
    "false length": lambda: _tensors("{}", 2**62),
    "long header": lambda: _tensors({"__metadata__": {"a": "x" * 4_000_000}}),
    "many tensors": lambda: _tensors(
        {f"t{n}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for n in range(100_000)}
    ),
    "false shape": lambda: _tensors({"a": {"dtype": "F32", "shape": [10**9, 10**9], "data_offsets": [0, 64]}}),
    "deep": lambda: _tensors("[" * 1_000_000),
    "metadata": lambda: _tensors({"__metadata__": {f"k{n}": "" for n in range(200_000)}}),
}


def _graph(nodes: Callable[[Any], list[Any]], **more: Any) -> bytes:
    import onnx  # noqa: PLC0415

    output = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, None)
    graph = onnx.helper.make_graph(nodes(onnx), "g", [], [output], **more)
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)]).SerializeToString()


def _filled(count: int) -> Callable[[Any], list[Any]]:
    def nodes(onnx: Any) -> list[Any]:
        shape = onnx.helper.make_tensor("s", onnx.TensorProto.INT64, [1], [count])
        node = onnx.helper.make_node
        return [node("Constant", [], ["s"], value=shape), node("ConstantOfShape", ["s"], ["y"])]

    return nodes


ONNX = {
    "constant of a terabyte": lambda: _graph(_filled(2**38)),
    "constant of 2 GB": lambda: _graph(_filled(2**29)),
    "many nodes": lambda: _graph(
        lambda onnx: [onnx.helper.make_node("Identity", [f"x{n}"], [f"x{n + 1}"]) for n in range(40_000)]
    ),
    "doubled": lambda: _graph(
        lambda onnx: [
            onnx.helper.make_node(
                "Constant", [], ["x0"], value=onnx.helper.make_tensor("v", onnx.TensorProto.FLOAT, [1], [1.0])
            ),
            *(onnx.helper.make_node("Concat", [f"x{n}"] * 8, [f"x{n + 1}"], axis=0) for n in range(11)),
            onnx.helper.make_node("Identity", ["x11"], ["y"]),
        ]
    ),
    "deep": lambda: b"\x3a\x80\x80\x01" * 200_000,
}


def _sqlite(*statements: str) -> Callable[[], bytes]:
    def make() -> bytes:
        connection = sqlite3.connect(":memory:")
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        return connection.serialize()

    return make


def _changed_project(*statements: str) -> Maker:
    def make(folder: Path) -> Path:
        _fill(folder)
        Project.open(Sequence.open(folder / "sequence.toml"), folder / "project.carts").close()
        with sqlite3.connect(folder / "project.carts") as connection:
            for statement in statements:
                connection.execute(statement)
        return folder / "project.carts"

    return make


_ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n"
PROJECT: dict[str, Maker] = {
    "endless view": _changed_project(f"CREATE VIEW v AS {_ENDLESS}"),
    "trigger": _changed_project(
        "CREATE TABLE t (a)", "CREATE TRIGGER g AFTER INSERT ON t BEGIN INSERT INTO t SELECT 1; END"
    ),
    "another database": _text(
        "project.carts", _sqlite("CREATE TABLE a (b)", "INSERT INTO a VALUES (zeroblob(2000000))")
    ),
    "many tables": _text("project.carts", _sqlite(*[f"CREATE TABLE a{n} (b)" for n in range(3_000)])),
    "false pages": _text(
        "project.carts",
        lambda: b"SQLite format 3\0" + struct.pack(">HBBBBBBIII", 4096, 1, 1, 0, 64, 32, 32, 1, 2**31, 0),
    ),
}


def _right(name: str) -> Maker:
    return lambda folder: (_fill(folder), folder / name)[1]


RIGHT: dict[str, Maker] = {
    **{kind: _right(f"{kind}.toml") for kind in ("settings", "manifest")},
    **{kind: _right(f"ball.{kind}") for kind in ("stl", "obj", "ply")},
    **{kind: _right("kinematics.csv") for kind in ("csv", "kinematics")},
    "toml": _right("sequence.toml"),
    "video": _right("video.mp4"),
    "image": _right("images/001.png"),
    "urdf": _right("two_links.urdf"),
    "safetensors": _right("weights.safetensors"),
    "yaml": _text("a.yaml", "camera_matrix: {data: [60, 0, 32, 0, 60, 24, 0, 0, 1]}"),
    "ini": _text("a.ini", "[StereoLeft]\nfc_x=60\nfc_y=60\ncc_x=32\ncc_y=24\nres_x=64\nres_y=48\n[StereoRight]\n"),
    "mat": _text("a.mat", _saved(K=np.diag([60.0, 60.0, 1.0]))),
    "json": _text("a.json", '{"K": [[60, 0, 32], [0, 60, 24], [0, 0, 1]]}'),
    "parquet": _parquet(lambda: pyarrow.table({"yaw": [0.1, 0.2]})),
    "npy": _text("a.npy", lambda: _npy(_shaped((2,)), bytes(16))),
    "npz": _text("a.npz", lambda: _zip({"a.npy": _npy(_shaped((2,)), bytes(16))})),
    "bag": _bag(lambda bag: None),
    "mcap": _damaged_mcap(lambda data: data),
    "xacro": _text("a.xacro", f'{_XACRO}<link name="a"/></robot>'),
    "dae": _text("a.dae", _dae()),
    "glb": _text("a.glb", lambda: _glb(_gltf(), _BIN)),
    "coco": _text("a.json", _coco),
    "cvat": _text("a.xml", _cvat('<polygon label="a" points="1,1;60,1;60,40"/>')),
    "surgpose": _text("a.yaml", "0: {1: [1, 2]}"),
    "labelme": _text("a.json", lambda: _labelme(_TRIANGLE_SHAPE)),
    "label studio": _text("a.json", lambda: _studio({"points": [[1, 1], [90, 1], [90, 90]]})),
    "yolo": _yolo("0 0.1 0.1 0.9 0.1 0.9 0.9\n"),
    "onnx": _text("a.onnx", lambda: _graph(_filled(4))),
    "project": _changed_project(),
    "batch": _text("job.json", '{"format": "carts-job/1"}'),
}
"""Right files of each kind."""


def _named(name: str, texts: dict[str, Any], around: Callable[[str], str] = str) -> dict[str, Maker]:
    def content(text: Callable[[], str | bytes]) -> Callable[[], str | bytes]:
        def make() -> str | bytes:
            made = text()
            return made if isinstance(made, bytes) else around(made)

        return make

    return {key: _text(name, content(text)) for key, text in texts.items()}


_REPEATED = {
    "blanks": " ", "blank lines": "\n", "brackets": "[", "comments": "#\n", "commas": ",", "digits": "1",
    "letters": "x", "quotes": '"',
}  # fmt: skip


def _repeated(name: str, head: str = "", tail: str = "") -> dict[str, Maker]:
    """Texts of half a megabyte of one token, within the syntax of a kind."""
    return {
        f"repeated {key}": _text(name, lambda token=token: head + token * (500_000 // len(token)) + tail)
        for key, token in _REPEATED.items()
    }


CASES: dict[str, dict[str, Maker]] = {
    "yaml": _named("a.yaml", YAML) | _repeated("a.yaml", "a: "),
    "ini": _named("a.ini", INI) | _repeated("a.ini", "[StereoLeft]\nfc_x = "),
    "mat": _named("a.mat", MAT),
    "json": _named("a.json", JSON) | _repeated("a.json", '{"K": '),
    "toml": _named("sequence.toml", TOML) | _repeated("sequence.toml", "a = "),
    "settings": _named("settings.toml", TOML),
    "manifest": _named("manifest.toml", TOML),
    "csv": _named("a.csv", CSV) | _repeated("a.csv", "yaw,a\n1,"),
    "kinematics": _named("kinematics.csv", CSV) | _repeated("kinematics.csv", "frame,time,yaw\n1,0.0,"),
    "parquet": PARQUET,
    "npy": _named("a.npy", NPY),
    "npz": _named("a.npz", NPZ),
    "bag": BAG,
    "mcap": MCAP,
    "video": VIDEO,
    "image": IMAGE,
    "urdf": _named("a.urdf", URDF) | _repeated("a.urdf", '<robot name="', '"/>'),
    "xacro": _named("a.xacro", XACRO, lambda text: f"{_XACRO}{text}</robot>") | _repeated("a.xacro", f"{_XACRO}${{"),
    "dae": _named("a.dae", DAE) | _repeated("a.dae", _dae()[:-60]),
    "obj": _named("a.obj", OBJ) | _repeated("a.obj", f"{_TRIANGLE}f 1 2 "),
    "stl": _named("a.stl", STL) | _repeated("a.stl", "solid a\nfacet normal 0 0 "),
    "ply": _named("a.ply", PLY) | _repeated("a.ply", "ply\nformat ascii 1.0\nelement vertex "),
    "glb": _named("a.glb", GLB),
    "coco": _named("a.json", COCO),
    "cvat": _named("a.xml", CVAT) | _repeated("a.xml", _CVAT_HEAD),
    "surgpose": _named("a.yaml", SURGPOSE) | _repeated("a.yaml", "0: {1: "),
    "labelme": _named("a.json", LABELME),
    "label studio": _named("a.json", LABEL_STUDIO),
    "yolo": {name: _yolo(text) for name, text in YOLO.items()},
    "safetensors": _named("a.safetensors", SAFETENSORS),
    "onnx": _named("a.onnx", ONNX),
    "project": PROJECT,
    "batch": _named("job.json", JSON, lambda text: f'{{"format": "carts-job/1", "status": {text}}}'),
}
"""Of each kind, files by the way in which they grow."""
