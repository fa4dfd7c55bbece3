"""Single-threaded operations, whose results do not depend on torch's number of threads.

Sums over whole images, and kernels that torch, oneDNN and MKL select by the number of threads, differ in their last
bits, which may trigger a restart of an optimization. Only these operations run in a single thread.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block, or the decorated function (`@one_thread()`), with one torch thread."""
    threads = torch.get_num_threads()
    if threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@one_thread()
def total(values: Tensor) -> float:
    """Sum of all values, independent of the number of threads."""
    return float(values.sum())
