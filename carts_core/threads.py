"""How many threads torch uses."""

import os

import torch

MOST = 4
"""More threads than this gain nothing on images as small as ours."""


def leave_a_core_free() -> None:
    """Let torch use all cores but one, four at most, unless `OMP_NUM_THREADS` says otherwise.

    Every parallel step of torch waits for its slowest thread. When all cores are asked for and another process (or
    our own web server) holds one of them, each step waits for the scheduler: an iteration of 0.1 s then takes 2.6 s.
    """
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(max(1, min((os.cpu_count() or 2) - 1, MOST)))
