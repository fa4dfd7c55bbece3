"""The lock that lets one writer in."""

import fcntl
import os
from pathlib import Path

import pytest

from carts_core.project.lock import WriterLock


def test_one_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    first = WriterLock.acquire(path)
    assert first is not None
    assert WriterLock.acquire(path) is None
    assert WriterLock.holder(path).startswith(f"process {os.getpid()} on ")
    first.release()
    assert not path.exists()
    second = WriterLock.acquire(path)
    assert second is not None
    second.release()


def test_a_lock_file_that_was_left_behind_is_no_lock(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    path.write_text("process 1 on another machine")
    lock = WriterLock.acquire(path)
    assert lock is not None
    lock.release()


def test_a_lock_file_that_its_holder_removes_while_it_is_being_locked_is_no_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lock"
    holder = WriterLock.acquire(path)
    assert holder is not None
    flock, locked = fcntl.flock, []

    def release_first(descriptor: int, operation: int) -> None:
        if not locked:
            holder.release()
        flock(descriptor, operation)
        locked.append(descriptor)

    monkeypatch.setattr(fcntl, "flock", release_first)
    second = WriterLock.acquire(path)
    assert second is not None and len(locked) == 2, "the file that was removed was locked, so it is tried again"
    assert WriterLock.acquire(path) is None, "the lock that counts is on the file under the name"
    second.release()
