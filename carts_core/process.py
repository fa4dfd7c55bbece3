"""Threads and memory of this process."""

import ctypes
import os
from collections.abc import Callable
from dataclasses import dataclass

MAX_THREADS = 4
"""Maximum useful number of threads for images of this size."""

_MMAP_THRESHOLD = 1 << 30
"""Allocations below this size come from the heap, which keeps freed memory [bytes]."""

_TRIM_THRESHOLD = 1 << 28
"""Amount of free memory at the end of the heap above which memory is returned to the system [bytes]."""

_ARENAS = 2
"""Number of malloc arenas. The default is up to 8 per core, each of which keeps its peak size."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
"""Parameter numbers from glibc's malloc.h."""


@dataclass
class _Tuned:
    """Tuning state of this process."""

    core_left_free: bool = False
    """Whether torch leaves a core free."""
    memory_kept: bool = False
    """Whether malloc keeps the memory of images."""


_TUNED = _Tuned()


def tune_process() -> None:
    """Tune threads and memory of the process; called at program start, not by libraries.

    Freed memory is kept for the next image, which is faster; a server returns memory with `return_memory`.
    """
    leave_a_core_free()
    keep_memory()


def processor_time() -> float:
    """Processor time of this process and of its children that have ended [s]."""
    return sum(os.times()[:4])


def leave_a_core_free() -> None:
    """Limit torch to one thread less than the number of cores, four at most, unless `OMP_NUM_THREADS` is set.

    Each parallel step waits for its slowest thread: with another process on one core, an iteration took 2.6 s instead
    of 0.1 s.
    """
    if "OMP_NUM_THREADS" not in os.environ and not _TUNED.core_left_free:
        import torch  # noqa: PLC0415  child processes without torch import this module, too

        torch.set_num_threads(max(1, min((os.cpu_count() or 2) - 1, MAX_THREADS)))
        _TUNED.core_left_free = True


def inference_threads() -> int:
    """Number of threads for ONNX Runtime: torch's, or one per core (four at most) if torch leaves a core free.

    ONNX Runtime distributes work in small pieces: with another process on one or both of two cores, two threads took
    0.73 and 0.53 of the time of one.
    """
    if _TUNED.core_left_free:
        return min(os.cpu_count() or 1, MAX_THREADS)
    import torch  # noqa: PLC0415

    return torch.get_num_threads()


def keep_memory() -> None:
    """Make glibc keep the memory of images instead of returning it to the system.

    The system clears each new page on first access, which increased the time of a 640x480 px rendering from 16 ms to 29
    ms. `MALLOC_...` variables of the environment take precedence.
    """
    mallopt = _of_malloc("mallopt")
    if mallopt is None:
        return
    for variable, parameter, value in (
        ("MALLOC_MMAP_THRESHOLD_", _M_MMAP_THRESHOLD, _MMAP_THRESHOLD),
        ("MALLOC_TRIM_THRESHOLD_", _M_TRIM_THRESHOLD, _TRIM_THRESHOLD),
        ("MALLOC_ARENA_MAX", _M_ARENA_MAX, _ARENAS),
    ):
        if variable not in os.environ:
            mallopt(parameter, value)
    _TUNED.memory_kept = True


def memory_kept() -> bool:
    """Whether malloc keeps the memory of images, so that libraries do not need their own memory pools."""
    return _TUNED.memory_kept


def return_memory() -> None:
    """Return freed memory to the system (glibc only)."""
    trim = _of_malloc("malloc_trim")
    if trim is not None:
        trim(0)


def _of_malloc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if os.name == "posix" else None
