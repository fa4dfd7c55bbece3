"""Untrusted files: files that are not regular, too large or nested too deeply are refused before processing."""

import os
import resource
import socket
import struct
import time
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.errors import CartsError, RobotError, SequenceError, WeightsError
from carts_core.files.reading import Kind, RefusedFileError, parse_json, parse_toml, read_bytes
from carts_core.model.link_mesh import mesh_path
from carts_core.model.meshes import read_mesh
from carts_core.model.robot import Robot
from carts_core.networks.weights import read_weights
from carts_core.recording.annotations.recognition import recognized
from carts_core.recording.images import read_image
from carts_core.recording.importing.foreign_tables import read_foreign_table
from carts_core.recording.importing.importer import find
from carts_core.recording.toml_table import read_toml
from carts_core.recording.video import index_video

SMALL = Kind("note", 10)
READERS: dict[str, Callable[[Path], object]] = {
    "toml": read_toml,
    "png": read_image,
    "mp4": index_video,
    "urdf": Robot.load,
    "stl": lambda path: read_mesh(path, np.ones(3), "a test names it"),
    "safetensors": read_weights,
}


def special_file(folder: Path, kind: str, name: str) -> Path:
    path = folder / name
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        bound = socket.socket(socket.AF_UNIX)
        bound.bind(str(path))
        bound.close()
    else:
        path.symlink_to({"zeros": "/dev/zero", "loop": name, "nothing": "absent"}[kind])
    return path


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["pipe", "socket", "zeros", "folder", "loop", "nothing"])
@pytest.mark.parametrize("suffix", READERS)
def test_special_files_are_refused_by_every_reader(tmp_path: Path, suffix: str, kind: str):
    path = special_file(tmp_path, kind, f"file.{suffix}")
    start = time.monotonic()
    with pytest.raises((SequenceError, RobotError, WeightsError)):
        READERS[suffix](path)
    assert time.monotonic() - start < 2.0


def test_links_to_regular_files_are_followed(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"12345")
    (tmp_path / "link").symlink_to("file")
    assert read_bytes(tmp_path / "link", SMALL) == b"12345"


def test_a_file_larger_than_its_kind_is_refused_with_both_sizes(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"12345678901")
    with pytest.raises(RefusedFileError, match="the limit for a note"):
        read_bytes(tmp_path / "file", SMALL)


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "/".join(["x" * 200] * 30)])
def test_names_that_no_file_can_have_are_missing_files(tmp_path: Path, name: str):
    with pytest.raises(CartsError):
        read_toml(tmp_path / name)
    with pytest.raises(RobotError):
        Robot.load(tmp_path / name)
    with pytest.raises(RobotError):
        read_mesh(mesh_path(tmp_path, name), np.ones(3), "a test names it")


@pytest.mark.timeout(20)
@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000 + "]" * 100_000,
        "a = " + "{ a = " * 2000 + "1" + " }" * 2000,
        "a." * 300_000 + "a = 1",
        '"a" . ' * 100_000 + "a = 1",
        "[" + "a." * 100_000 + "a]",
        "a = " + "9" * 5000,
        "a = 0x" + "f" * 100_000,
        "\n".join(f"[{'a.' * depth}a]" for depth in range(60)),
    ],
)
def test_toml_without_end_is_refused_at_once(text: str):
    start = time.process_time()
    with pytest.raises(ValueError):
        parse_toml(text)
    assert time.process_time() - start < 5.0


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "[" * 50 + "]" * 50, "[" + "[]," * 3_000_000 + "0]", "NaN", "[1e999]", "9" * 5000, "-" + "9" * 30],
)
def test_json_without_end_or_with_numbers_that_are_not_finite_is_refused(text: str):
    with pytest.raises(ValueError):
        parse_json(text)


def png_header(width: int, height: int) -> bytes:
    """A PNG of one colour, whose pixels take kilobytes in the file."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(10_000))) + chunk(b"IEND", b"")
    )


def encoded_header(suffix: str, width: int, height: int) -> bytes:
    """Small image whose header gives another size."""
    content = bytearray(cv2.imencode(suffix, np.zeros((8, 16, 3), np.uint8))[1].tobytes())
    if suffix == ".jpg":
        place = content.index(b"\xff\xc0") + 5
        content[place : place + 4] = struct.pack(">HH", height, width)
    elif suffix == ".bmp":
        content[18:26] = struct.pack("<ii", width, height)
    return bytes(content)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_a_huge_image_is_refused_before_it_is_decoded(tmp_path: Path, suffix: str):
    path = tmp_path / f"huge{suffix}"
    path.write_bytes(png_header(30_000, 30_000) if suffix == ".png" else encoded_header(suffix, 30_000, 30_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SequenceError, match=r"is (30000 x 30000 pixels|too large); the limit is 40 million pixels"):
        read_image(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


def test_an_image_of_no_known_kind_is_refused(tmp_path: Path):
    (tmp_path / "image.png").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n" + bytes(4))
    with pytest.raises(SequenceError, match="must be a JPEG, PNG, TIFF, BMP, WebP or PPM image"):
        read_image(tmp_path / "image.png")


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab\nsize 12345\n"


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("recording.bag", find),
        ("recording.mcap", find),
        ("recording_0.db3", find),
        ("image.png", read_image),
        ("video.mp4", index_video),
        ("weights.safetensors", read_weights),
        ("robot.urdf", Robot.load),
        ("mesh.stl", lambda path: read_mesh(path, np.ones(3), "a test")),
        ("sequence.toml", read_toml),
        ("table.csv", read_foreign_table),
        ("table.parquet", read_foreign_table),
        ("masks.json", lambda path: recognized(path, None, Counter())),
    ],
)
def test_git_lfs_pointers_are_recognized_everywhere(tmp_path: Path, name: str, read: Callable[[Path], object]):
    (tmp_path / name).write_text(POINTER)
    with pytest.raises(CartsError, match=r"a Git LFS pointer.*run `git lfs pull`"):
        read(tmp_path / name)
