"""What this process asks of the machine: how many threads, and what becomes of memory it has used."""

import ctypes
import os
from dataclasses import dataclass

import torch

MOST_THREADS = 4
"""More threads than this gain nothing on images as small as ours."""

_MMAP_THRESHOLD = 1 << 30
"""Allocations below this come from the heap, which keeps what is freed [bytes]."""

_TRIM_THRESHOLD = 1 << 28
"""Free memory at the end of the heap beyond which some is given back to the system [bytes]."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Numbers of these parameters in glibc's malloc.h."""


@dataclass
class _Cores:
    """Of this process."""

    left_free: bool = False
    """Whether torch leaves one to others."""


_CORES = _Cores()


def tune_process(*, keep_memory: bool) -> None:
    """Set up a program, at its start; a library leaves both to its caller.

    Args:
        keep_memory: keep freed memory for the next image, which is faster. A server that runs for days had rather give
            it back: in an hour of use it held 1.09 GB instead of 1.00 GB, and took longer to stop growing.
    """
    _leave_a_core_free()
    if keep_memory:
        _keep_memory()


def _leave_a_core_free() -> None:
    """Let torch use all cores but one, four at most, unless `OMP_NUM_THREADS` says otherwise.

    Every parallel step of torch waits for its slowest thread. When all cores are asked for and another process (or
    our own web server) holds one of them, each step waits for the scheduler: an iteration of 0.1 s then takes 2.6 s.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(max(1, min((os.cpu_count() or 2) - 1, MOST_THREADS)))
        _CORES.left_free = True


def inference_threads() -> int:
    """Threads of ONNX Runtime: torch's, or one for every core, four at most, where a core was left free.

    Its threads hand out work in small pieces, so that one that has to wait for a core holds up no other: with another
    process on one or on both of two cores, two threads took .73 and .53 of the time of one.
    """
    return min(os.cpu_count() or 1, MOST_THREADS) if _CORES.left_free else torch.get_num_threads()


def _keep_memory() -> None:
    """Have glibc, where that is the C library, keep memory of images instead of returning and asking for it anew.

    The system hands out memory a page at a time, as it is first written to, and clears every page: a rendering of
    640x480 px took 29 ms with that and 16 ms without, in one run beside other programs. `MALLOC_...` variables of the
    environment count for more.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is None:
        return
    if "MALLOC_MMAP_THRESHOLD_" not in os.environ:
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD)
    if "MALLOC_TRIM_THRESHOLD_" not in os.environ:
        mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD)
