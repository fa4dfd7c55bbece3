"""Many wrong inputs, each within a time and an amount of memory, in a worker process that may die."""

import multiprocessing
import os
import random
import resource
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from carts_core.errors import CartsError
from fuzz.kinds import KINDS, NotFiniteError, make_folder

SECONDS = 10.0
"""Of computing that an input may take [s]."""
PATIENCE = 120.0
"""How long an answer is waited for on a busy machine [s]."""
MEMORY = 2 * 2**30
"""Memory limit of the worker, above its memory before the first input [bytes]."""


@dataclass(frozen=True)
class Outcome:
    """What became of one input."""

    kind: str
    seed: int
    result: str
    """`read`, `refused`, or a failure: `traceback`, `hang`, `memory`, `not finite`, `died`."""
    detail: str = ""
    seconds: float = 0.0


GOOD = ("read", "refused")


def wrong_input(kind: str, seed: int, content: bytes) -> bytes:
    """The input of a kind with a number."""
    return KINDS[kind].mutate(content, random.Random(f"{kind} {seed}"))


def run(count: int, seed: int, kinds: tuple[str, ...] = tuple(KINDS)) -> Iterator[Outcome]:
    """The outcome of `count` inputs, the kinds in turn."""
    jobs = [(kinds[number % len(kinds)], seed + number // len(kinds)) for number in range(count)]
    # Not forked: the threads of libraries in use do not come along, and what waits for them dies.
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="carts-fuzz-") as name:
        folder = Path(name) / "files"
        os.environ["CARTS_CACHE"] = str(Path(name) / "cache")
        make_folder(folder)
        position = 0
        while position < len(jobs):
            here, there = context.Pipe()
            worker = context.Process(target=_work, args=(folder, jobs[position:], there), daemon=True)
            worker.start()
            there.close()
            for outcome in _watched(here, jobs[position:]):
                position += 1
                yield outcome
            worker.kill()
            worker.join()


def _watched(pipe: Connection, jobs: list[tuple[str, int]]) -> Iterator[Outcome]:
    """Outcomes as the worker sends them, up to the first input that it does not get over."""
    for kind, seed in jobs:
        try:
            if not pipe.poll(PATIENCE):
                yield Outcome(kind, seed, "hang", seconds=PATIENCE)
                return
            yield pipe.recv()
        except EOFError:
            yield Outcome(kind, seed, "died")
            return


def _work(folder: Path, jobs: list[tuple[str, int]], pipe: Connection) -> None:
    torch.set_num_threads(1)
    # What FFmpeg and libtiff say of wrong files is of no interest.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    # Libraries and their threads take their memory with the first right input, however many processors there are.
    for kind in dict.fromkeys(kind for kind, _ in jobs):
        KINDS[kind].read(folder / KINDS[kind].file)
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + 2 * MEMORY, resource.RLIM_INFINITY))
    right = {kind: (folder / entry.file).read_bytes() for kind, entry in KINDS.items()}
    for kind, seed in jobs:
        pipe.send(_outcome(folder, kind, seed, right[kind]))


def _outcome(folder: Path, kind: str, seed: int, right: bytes) -> Outcome:
    path = folder / KINDS[kind].file
    path.write_bytes(wrong_input(kind, seed, right))
    Path("/proc/self/clear_refs").write_text("5")  # The peak is counted from here on.
    before, start = _memory("VmRSS"), time.process_time()
    detail = ""
    try:
        KINDS[kind].read(path)
        result = "read"
    except CartsError as error:
        result, detail = "refused", str(error)
    except NotFiniteError:
        result, detail = "not finite", traceback.format_exc()
    except BaseException:
        result, detail = "traceback", traceback.format_exc()
    seconds = time.process_time() - start
    if result in GOOD and seconds > SECONDS:
        result = "hang"
    if result in GOOD and _memory("VmHWM") - before > MEMORY:
        result = "memory"
    path.write_bytes(right)
    return Outcome(kind, seed, result, detail, seconds)


def _memory(key: str) -> int:
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return 1024 * int(status[key].split()[0])
