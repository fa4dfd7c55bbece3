"""The write-ahead log of a project that was not closed: what of it counts, and whether something in it is damaged.

SQLite takes a log up to its first damaged frame and says nothing about the rest. After a kill the rest can only be the
beginning of a transaction that was never acknowledged; anything else in it is damage, which we want to know of.
Format: https://www.sqlite.org/fileformat2.html#the_write_ahead_log
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import UInt32

HEADER = 32
"""Bytes before the first frame."""
FRAME_HEADER = 24
"""Bytes before each frame's page."""
_BIG_ENDIAN_MAGIC, _LITTLE_ENDIAN_MAGIC = 0x377F0683, 0x377F0682
_Sum = tuple[int, int]


@dataclass(frozen=True)
class Playback:
    """A database with its log played back."""

    database: bytearray
    damaged: bool
    """Whether there is more in the log than finished transactions and the beginning of one; for logs that began empty,
    as ours all do."""


def played_back(database: bytes, log: bytes) -> Playback:
    """The database after all transactions that were finished, as SQLite has it.

    Args:
        database: content of the database file.
        log: content of the log, which may be empty.
    """
    result = bytearray(database)
    if len(log) < HEADER:
        # A header is written at once, before anything else; less of it is a kill in that moment.
        return Playback(result, damaged=False)
    magic, _, page_size, _, *salts = struct.unpack_from(">6I", log)
    order = ">" if magic == _BIG_ENDIAN_MAGIC else "<"
    running = struct.unpack_from(">2I", log, 24)
    known = magic in (_BIG_ENDIAN_MAGIC, _LITTLE_ENDIAN_MAGIC)
    if not known or page_size not in (1 << n for n in range(9, 17)) or _checksum(order, log[:24], (0, 0)) != running:
        return Playback(result, damaged=True)
    unfinished: list[tuple[int, int]] = []
    for start in range(HEADER, len(log) - FRAME_HEADER - page_size + 1, FRAME_HEADER + page_size):
        number, pages, *rest = struct.unpack_from(">6I", log, start)
        begin = start + FRAME_HEADER
        running = _checksum(order, log[start : start + 8], running)
        running = _checksum(order, log[begin : begin + page_size], running)
        if rest != [*salts, *running] or number == 0:
            return Playback(result, damaged=True)
        unfinished.append((number, begin))
        if pages:
            for page, place in unfinished:
                end = page * page_size
                result.extend(bytes(max(end - len(result), 0)))
                result[end - page_size : end] = log[place : place + page_size]
            unfinished.clear()
            del result[pages * page_size :]
    return Playback(result, damaged=False)


@dataclass(frozen=True)
class Mark:
    """Where the last frame of a finished transaction begins."""

    start: int = HEADER
    """Offset of the frame in the log [bytes]."""
    running: _Sum | None = None
    """The checksum before it; None: the header's."""
    frames: int = 0
    """0: the log has no transaction yet, 1: this frame."""


def next_mark(log: bytes, header: bytes, mark: Mark) -> Mark | None:
    """The last frame of the next transaction, if the frame at `mark` and all after it up to there are whole.

    Args:
        log: content of the log from `mark.start`.
        header: the log's header.
        mark: of the transaction before.
    """
    if len(header) < HEADER:
        return None
    magic, _, page_size, _, *salts = struct.unpack_from(">6I", header)
    order = ">" if magic == _BIG_ENDIAN_MAGIC else "<"
    running: _Sum = mark.running or struct.unpack_from(">2I", header, 24)
    commits = 0
    for start in range(0, len(log) - FRAME_HEADER - page_size + 1, FRAME_HEADER + page_size):
        before = running
        _, pages, *rest = struct.unpack_from(">6I", log, start)
        begin = start + FRAME_HEADER
        running = _checksum(order, log[begin : begin + page_size], _checksum(order, log[start : start + 8], running))
        if rest != [*salts, *running]:
            return None
        commits += bool(pages)
        if commits > mark.frames:
            return Mark(mark.start + start, before, 1)
    return None


def _checksum(order: Literal["<", ">"], data: bytes, start: _Sum) -> _Sum:
    """The running checksum of the format, continued by a multiple of 8 bytes.

    Each pair of words (x, y) takes the sums (s, t) to s' = s + x + t and t' = t + y + s', modulo 2^32. This is linear,
    so a whole page is two sums of products.
    """
    words = np.frombuffer(data, np.dtype(np.uint32).newbyteorder(order)).astype(np.uint32)
    added = np.stack((words[::2], words[::2] + words[1::2]), axis=-1)
    powers = _powers(len(added))
    whole = (powers[-1] * np.array(start, np.uint32)).sum(axis=-1, dtype=np.uint32)
    whole = whole + (powers[-2::-1] * added[:, None, :]).sum(axis=(0, 2), dtype=np.uint32)
    return int(whole[0]), int(whole[1])


@lru_cache(maxsize=8)
def _powers(pairs: int) -> UInt32[np.ndarray, "pairs+1 2 2"]:
    """Powers 0 to `pairs` of the matrix that takes one pair's sums to the next."""
    powers, (a, b, c, d) = [], (1, 0, 0, 1)
    for _ in range(pairs + 1):
        powers.append(((a, b), (c, d)))
        a, b, c, d = (value & 0xFFFFFFFF for value in (a + c, b + d, a + 2 * c, b + 2 * d))
    return np.array(powers, np.uint32)
