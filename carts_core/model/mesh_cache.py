"""Disk cache of decimated link meshes."""

import hashlib
import os
import zipfile
import zlib
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from ..errors import OutputError
from ..files import locked_folder, output_path, output_stream
from ..files.paths import home
from ..files.reading import CACHED, MESH, open_regular, read_bytes
from .link_mesh import Decimation, LinkMesh

_VERSION = 3


def cache_dir() -> Path:
    """Folder of the cache: `$CARTS_CACHE`, else `$XDG_CACHE_HOME/carts`, else `~/.cache/carts`."""
    if configured := os.environ.get("CARTS_CACHE"):
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or home() / ".cache") / "carts"


def fingerprint(files: Iterable[Path], *settings: object) -> str:
    """Key that depends on the content of files, on settings and on the format of the cache."""
    digest = hashlib.sha256(repr((_VERSION, settings)).encode())
    for file in files:
        digest.update(str(file.name).encode())
        digest.update(read_bytes(file, MESH))
    return digest.hexdigest()[:32]


PreparedMeshes = tuple[tuple[LinkMesh, ...], Decimation]
"""Meshes of links, and a summary of their decimation."""


def cached_meshes(key: str, make: Callable[[], PreparedMeshes]) -> PreparedMeshes:
    """Return the entry of a key; a missing entry is computed and stored.

    Concurrent processes wait for the process that computes the entry, unless the cache cannot be locked.
    """
    if (stored := read(key)) is not None:
        return stored
    with ExitStack() as held:
        with suppress(OutputError):
            held.enter_context(locked_folder(output_path(cache_dir()), wait=True))
        if (stored := read(key)) is not None:
            return stored
        made = make()
        write(key, *made)
        return made


def read(key: str) -> PreparedMeshes | None:
    """Read the entry of a key; None for a missing or damaged entry."""
    try:
        with (
            open_regular(cache_dir() / f"{key}.npz", CACHED) as file,
            np.load(file, allow_pickle=False) as stored,
        ):
            meshes = []
            for i in range(int(stored["count"])):
                arrays = {name: stored[f"{i}_{name}"] for name in ("vertices", "normals", "faces", "color")}
                link, closed = int(stored[f"{i}_link"]), bool(stored[f"{i}_closed"])
                meshes.append(LinkMesh(link=link, closed=closed, **arrays))
            return tuple(meshes), Decimation(int(stored["before"]), int(stored["after"]), float(stored["deviation"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


def write(key: str, meshes: tuple[LinkMesh, ...], decimation: Decimation) -> None:
    """Store an entry; an unwritable cache is not an error."""
    arrays: dict[str, np.ndarray] = {
        "count": np.array(len(meshes)),
        "before": np.array(decimation.before),
        "after": np.array(decimation.after),
        "deviation": np.array(decimation.deviation),
    }
    for i, mesh in enumerate(meshes):
        for field in ("link", "vertices", "normals", "faces", "color", "closed"):
            arrays[f"{i}_{field}"] = np.asarray(getattr(mesh, field))
    with suppress(OutputError), output_stream(output_path(cache_dir(), f"{key}.npz")) as stream:
        np.savez(stream, **arrays)  # pyright: ignore[reportArgumentType]
