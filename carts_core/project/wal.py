"""The write-ahead log of a project that was not closed: what of it counts, and whether something in it is damaged.

SQLite takes a log up to its first damaged frame and says nothing about the rest. After a kill the rest can only be the
beginning of a transaction that was never acknowledged; anything else in it is damage, which we want to know of.
Format: https://www.sqlite.org/fileformat2.html#the_write_ahead_log
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import UInt8, UInt32

HEADER = 32
"""Bytes before the first frame."""
FRAME_HEADER = 24
"""Bytes before each frame's page."""
_BIG_ENDIAN_MAGIC, _LITTLE_ENDIAN_MAGIC = 0x377F0683, 0x377F0682
_COVERED = 8
"""Bytes of a frame's header that its checksum covers, besides its page."""
_WORD = 0xFFFFFFFF
_FRAMES_AT_ONCE = 256
_PAGE_SIZES = frozenset(1 << n for n in range(9, 17))
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
    first = struct.unpack_from(">2I", log, 24)
    known = magic in (_BIG_ENDIAN_MAGIC, _LITTLE_ENDIAN_MAGIC)
    if not known or page_size not in _PAGE_SIZES or _header_sum(order, log) != first:
        return Playback(result, damaged=True)
    unfinished: list[tuple[int, int]] = []
    for start, running in _running_sums(order, log, HEADER, page_size, first):
        number, pages, *rest = struct.unpack_from(">6I", log, start)
        begin = start + FRAME_HEADER
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
    if page_size not in _PAGE_SIZES:
        # Somebody has written over it.
        return None
    order = ">" if magic == _BIG_ENDIAN_MAGIC else "<"
    before: _Sum = mark.running or struct.unpack_from(">2I", header, 24)
    commits = 0
    for start, running in _running_sums(order, log, 0, page_size, before):
        _, pages, *rest = struct.unpack_from(">6I", log, start)
        if rest != [*salts, *running]:
            return None
        commits += bool(pages)
        if commits > mark.frames:
            return Mark(mark.start + start, before, 1)
        before = running
    return None


def _running_sums(
    order: Literal["<", ">"], log: bytes, start: int, page_size: int, running: _Sum
) -> Iterator[tuple[int, _Sum]]:
    """Where each whole frame begins, and the checksum of the log up to its end.

    Args:
        order: byte order of the words.
        log: content of the log.
        start: where the first frame begins.
        page_size: what each frame holds [bytes].
        running: the checksum before it.
    """
    size = FRAME_HEADER + page_size
    weights, ((a, b), (c, d)) = _weights((_COVERED + page_size) // 4)
    while count := min((len(log) - start) // size, _FRAMES_AT_ONCE):
        frames = np.frombuffer(log, np.uint8, count * size, start).reshape(count, size)
        covered = np.concatenate((frames[:, :_COVERED], frames[:, FRAME_HEADER:]), axis=1)
        for x, y in (_words(order, covered) @ weights).tolist():
            s, t = running
            running = (x + a * s + b * t) & _WORD, (y + c * s + d * t) & _WORD
            yield start, running
            start += size


def _header_sum(order: Literal["<", ">"], log: bytes) -> _Sum:
    words = _words(order, np.frombuffer(log, np.uint8, HEADER - 8))
    first, second = (words @ _weights(len(words))[0]).tolist()
    return first, second


def _words(order: Literal["<", ">"], data: UInt8[np.ndarray, "*rows bytes"]) -> UInt32[np.ndarray, "*rows words"]:
    return data.view(np.dtype(np.uint32).newbyteorder(order)).astype(np.uint32, copy=False)


@lru_cache(maxsize=8)
def _weights(words: int) -> tuple[UInt32[np.ndarray, "words 2"], tuple[_Sum, _Sum]]:
    """What each word adds to the two sums of a checksum, and the matrix that takes the sums before the words along.

    Each pair of words (x, y) takes the sums (s, t) to s' = s + x + t and t' = t + y + s', modulo 2^32. This is linear,
    so that any number of words are two sums of products.
    """
    columns, (a, b, c, d) = [], (1, 0, 0, 1)
    for _ in range(words // 2):
        # The last pair comes first: nothing follows it.
        columns.append((((a + b) & _WORD, (c + d) & _WORD), (b, d)))
        a, b, c, d = (value & _WORD for value in (a + b, a + 2 * b, c + d, c + 2 * d))
    weights = [word for pair in reversed(columns) for word in pair]
    return np.array(weights, np.uint32).reshape(-1, 2), ((a, b), (c, d))
