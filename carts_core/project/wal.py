"""The write-ahead log of a project that was not closed: whether SQLite would drop something that was saved.

SQLite takes a log up to its first damaged frame and says nothing about the rest. After a kill the rest can only be the
beginning of a transaction that was never acknowledged; anything else in it is damage.
Format: https://www.sqlite.org/fileformat2.html#the_write_ahead_log
"""

import struct

HEADER = 32
"""Bytes before the first frame."""
FRAME_HEADER = 24
"""Bytes before each frame's page."""
_BIG_ENDIAN_MAGIC, _LITTLE_ENDIAN_MAGIC = 0x377F0683, 0x377F0682


def drops_edits(log: bytes, recovered: int) -> bool:
    """Whether there is more in a log than the recovered frames and a transaction that was being written.

    Only for logs that began empty, as ours all do.

    Args:
        log: the file's content.
        recovered: how many frames SQLite takes.
    """
    if len(log) < HEADER:
        # It is written before anything else, at once; less of it is a kill in that moment.
        return recovered > 0
    magic, _, page, _, *salts_and_sum = struct.unpack_from(">8I", log)
    if magic not in (_BIG_ENDIAN_MAGIC, _LITTLE_ENDIAN_MAGIC) or not 512 <= page <= 65536:
        return True
    order = ">" if magic == _BIG_ENDIAN_MAGIC else "<"
    salts, running = tuple(salts_and_sum[:2]), (salts_and_sum[2], salts_and_sum[3])
    if _checksum(order, log[:24], (0, 0)) != running:
        return True
    size = FRAME_HEADER + page
    if recovered:
        running = struct.unpack_from(">2I", log, HEADER + (recovered - 1) * size + 16)
    for start in range(HEADER + recovered * size, len(log) - size + 1, size):
        _, pages, *rest = struct.unpack_from(">6I", log, start)
        running = _checksum(order, log[start : start + 8], running)
        running = _checksum(order, log[start + FRAME_HEADER : start + size], running)
        if tuple(rest[:2]) != salts or tuple(rest[2:]) != running or pages:
            return True
    return False


def _checksum(order: str, data: bytes, start: tuple[int, int]) -> tuple[int, int]:
    """The running checksum of the format, continued."""
    first, second = start
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for even, odd in zip(words[::2], words[1::2], strict=True):
        first = (first + even + second) & 0xFFFFFFFF
        second = (second + odd + first) & 0xFFFFFFFF
    return first, second
