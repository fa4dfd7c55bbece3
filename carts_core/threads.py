"""Results that do not depend on torch's number of threads.

Most operations give the same bits however many threads share them: each value is the work of one thread. Sums over a
whole image are not among them (every thread adds up a part), nor are some kernels that torch, oneDNN and MKL choose by
the number of threads. Their last bits would decide whether an optimization begins again elsewhere, so these few run in
one thread, which costs little: the convolutions, which take the time, keep all of theirs.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block, or decorated function (`@one_thread()`), with one thread of torch."""
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
    """The sum over all values."""
    return float(values.sum())
