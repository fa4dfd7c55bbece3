"""Uploads of files from a browser into an allowed folder, over a websocket of their own.

The browser sends lists of files (`Listing`), then the content of each file in order, in messages of at most 1 MiB. The
server answers each listing and each message with `{"received": BYTES}`, and ends with `{"folder": PATH}` or
`{"error": TEXT}`. The folder appears once all files are complete.
"""

import asyncio
import shutil
from collections.abc import Generator, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import msgspec
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from carts_core.errors import CartsError, SettingsError
from carts_core.files import file_name, name_fault, output_path, output_stream, published

MAX_FILES = 100_000
"""Maximum number of files of an upload."""
MAX_BYTES = 32 * 2**30
"""Maximum size of an upload [bytes]."""
KEPT_FREE = 2**30
"""Disk space that an upload leaves free [bytes]."""
_MAX_DEPTH = 8
_FOLDER = "upload"
"""Name of the new folder for files without a common folder."""


class Listing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Chunk of the list of files."""

    files: list[tuple[Annotated[str, msgspec.Meta(max_length=4096)], Annotated[int, msgspec.Meta(ge=0, le=MAX_BYTES)]]]
    """Path, which begins with the name of a dropped folder, and size [bytes]."""
    more: bool = False
    """Whether another chunk follows."""


def sanitized(path: str) -> tuple[str, ...]:
    """Names of an untrusted relative path; names that are not allowed are replaced."""
    parts = [part for part in path.split("/") if part]
    return tuple(part if name_fault(part) is None else file_name(part) for part in parts) or ("_",)


def receive(root: Path, files: Iterable[tuple[str, int]]) -> Generator[None, bytes, Path]:
    """Write files into a new folder below `root`; send each part of their contents, in order.

    Args:
        root: allowed folder.
        files: untrusted relative path and size [bytes] of each file.

    Returns:
        The new folder.

    Raises:
        SettingsError: there are no, too many or too large files, two have the same name, or a part exceeds its file.
        OutputError: the files cannot be written.
    """
    listed = [(sanitized(path), size) for path, size in files]
    _check(root, listed)
    tops = {names[0] for names, _ in listed if len(names) > 1}
    common = tops.pop() if len(tops) == 1 and all(len(names) > 1 for names, _ in listed) else None
    folder = _free(root, common or _FOLDER)
    with published(output_path(root, folder.name)) as output:
        for names, size in listed:
            target = output
            for name in names if common is None else names[1:]:
                target = target / name
            with output_stream(target) as stream:
                left = size
                while left:
                    part = yield
                    if len(part) > left:
                        raise SettingsError(f"{'/'.join(names)} changed during the upload. Upload it again.")
                    stream.write(part)
                    left -= len(part)
    return folder


def _check(root: Path, listed: list[tuple[tuple[str, ...], int]]) -> None:
    if not 0 < len(listed) <= MAX_FILES:
        raise SettingsError(f"the upload has {len(listed)} files; 1 to {MAX_FILES:,} are allowed.")
    if deep := next((names for names, _ in listed if len(names) > _MAX_DEPTH), None):
        raise SettingsError(f"{'/'.join(deep)} is more than {_MAX_DEPTH} levels deep. Drop the inner folder.")
    total, free = sum(size for _, size in listed), shutil.disk_usage(root).free - KEPT_FREE
    if total > min(MAX_BYTES, free):
        why = f" ({root} must keep 1 GB free)" if free < MAX_BYTES else ""
        raise SettingsError(
            f"the upload has {total / 1e9:.1f} GB; at most {max(min(MAX_BYTES, free), 0) / 1e9:.1f} GB are allowed"
            f"{why}. Copy it to the computer of the viewer instead."
        )
    seen: dict[str, tuple[str, ...]] = {}
    for names, _ in listed:
        key = "/".join(names).casefold()
        if key in seen:
            raise SettingsError(f"two files are named {'/'.join(names)}. Rename one of them.")
        seen[key] = names


def _free(root: Path, name: str) -> Path:
    """Path below `root` that does not exist: the name, with a number if needed."""
    folder, number = root / name, 2
    while folder.exists() or folder.is_symlink():
        folder, number = root / f"{name}_{number}", number + 1
    return folder


class Uploads:
    """Receives uploads, one at a time.

    Args:
        root: folder of the uploads.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._running: ServerConnection | None = None

    async def serve(self, connection: ServerConnection) -> None:
        """Receive one upload; nothing is kept if the connection is lost."""
        if self._running is not None:
            return await _answer(connection, error="Another upload is running. Wait until it ends.")
        self._running = connection
        with suppress(ConnectionClosed):
            try:
                folder = await self._receive(connection)
            except (CartsError, msgspec.DecodeError, OSError) as error:
                await _answer(connection, error=str(error))
            else:
                await _answer(connection, folder=str(folder))
            finally:
                self._running = None

    def close(self) -> None:
        """Close the connection of the running upload. Thread-safe."""
        if (running := self._running) is not None:
            why = "The start page was closed, which ended the upload. Upload the files again."
            asyncio.run_coroutine_threadsafe(running.close(reason=why), running.loop)

    async def _receive(self, connection: ServerConnection) -> Path:
        files: list[tuple[str, int]] = []
        more = True
        while more:
            listing = msgspec.json.decode(await connection.recv(), type=Listing)
            files += listing.files
            more = listing.more and len(files) <= MAX_FILES
            if more:
                await _answer(connection, received=0)
        writer = receive(self.root, files)
        received = 0
        try:
            # Writing blocks, so it runs in other threads, one call at a time.
            done = await asyncio.to_thread(_step, writer, None)
            while done is None:
                await _answer(connection, received=received)
                part = await connection.recv()
                if not isinstance(part, bytes) or not part:
                    raise SettingsError("the upload was interrupted. Upload the files again.")
                received += len(part)
                done = await asyncio.to_thread(_step, writer, part)
            return done
        finally:
            await asyncio.to_thread(writer.close)


def _step(writer: Generator[None, bytes, Path], part: bytes | None) -> Path | None:
    """Pass a part to the writer; returns its result at the end."""
    try:
        next(writer) if part is None else writer.send(part)
    except StopIteration as end:
        return end.value
    return None


async def _answer(connection: ServerConnection, **values: str | int) -> None:
    await connection.send(msgspec.json.encode(values).decode())
