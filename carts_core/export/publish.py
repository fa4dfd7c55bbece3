"""An export appears under its final name whole or not at all, whatever happens while it is written."""

import ctypes
import fcntl
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import CartsError

MARKER = "export.json"
"""Every exported folder holds this file; a folder without it is never replaced."""


@contextmanager
def published(target: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Where to write an export, which becomes `target` when the block ends without an exception.

    The export is written in a hidden folder `.NAME.part` beside `target`. When the block fails or is interrupted that
    folder is removed; when the process is killed it stays, and the next export to the same target removes it.

    Args:
        target: file or folder to make. An empty folder counts as absent.
        overwrite: replace what is there: a file, or a folder that is an export itself.

    Yields:
        A path, not yet there, with the target's name; write a file or a folder there.

    Raises:
        CartsError: the target exists and may not be replaced, somebody else is exporting to it, or the disk refuses.
    """
    target = target.resolve()
    part = target.with_name(f".{target.name}.part")
    try:
        part.mkdir(parents=True, exist_ok=True)
        with _locked(part, target):
            try:
                _restore(part, target)
                _check_free(target, overwrite)
                for leftover in part.iterdir():
                    _remove(leftover)
                content = part / target.name
                yield content
                _check_free(target, overwrite)
                _move(content, target)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise CartsError(
            f"{target} cannot be written ({error.strerror or error}). "
            "Nothing was changed there. Make room, or name a folder you may write to."
        ) from error


def _restore(part: Path, target: Path) -> None:
    """Put back what a process was about to replace when it was killed between the two renames of `_move`."""
    old = part / f"{target.name}.old"
    if old.exists() and not target.exists():
        os.rename(old, target)


def _check_free(target: Path, overwrite: bool) -> None:
    if target.is_dir():
        if not any(target.iterdir()):
            return
        if not (target / MARKER).is_file():
            raise CartsError(
                f"{target} is a folder with other files ({MARKER} is not among them), and these are never replaced. "
                "Name a new folder."
            )
    if target.exists() and not overwrite:
        raise CartsError(f"{target} exists. Add --overwrite to replace it, or name another output.")


@contextmanager
def _locked(part: Path, target: Path) -> Iterator[None]:
    """Hold the folder `part`; the system releases it when the process ends, however it ends."""
    handle = os.open(part, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise CartsError(f"another export to {target} is running. Wait for it, or name another output.") from error
        yield
    finally:
        os.close(handle)


def _move(content: Path, target: Path) -> None:
    if target.is_dir() and any(target.iterdir()):
        if not _exchanged(content, target):
            old = content.with_name(f"{target.name}.old")
            os.rename(target, old)
            try:
                os.rename(content, target)
            except OSError:
                os.rename(old, target)
                raise
    else:
        os.replace(content, target)


def _exchanged(one: Path, other: Path) -> bool:
    """Let two paths change places in one step, where the system can."""
    if not sys.platform.startswith("linux"):
        return False
    at_present_folder, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of renameat2(2)
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    arguments = (at_present_folder, os.fsencode(one), at_present_folder, os.fsencode(other), exchange)
    return rename is not None and rename(*arguments) == 0


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
