"""Small files that grow when they are read: each is read in a process of its own, whose time and memory are measured.

PYTHONPATH=tests python -m fuzz.growing "yaml/aliases" "npz/false small size"
"""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from carts_core.errors import CartsError
from fuzz.growing_files import CASES, READERS, RIGHT, right_folder

SECONDS = 5.0
"""Of processor time, of the process and its children [s]."""
MEMORY = 512 * 2**20
"""Memory limit for small files, in addition to the interpreter and the imports of this process [bytes]."""
INTERPRETER = 60 * 2**20
"""Memory of a child process that has imported little [bytes]."""
PATIENCE = 180
"""[s]"""


@dataclass(frozen=True)
class Cost:
    """What reading a file took."""

    kind: str
    name: str
    result: str
    """`read`, `refused`, or a failure: `traceback`, `slow`, `memory`, `died`."""
    size: int
    """Of the file [bytes]."""
    seconds: float
    """[s]"""
    memory: int
    """[bytes]"""
    detail: str = ""

    @property
    def wrong(self) -> bool:
        """Whether the file was neither read nor refused at a small cost."""
        return self.result not in ("read", "refused")


def measured(kind: str, name: str, make: Callable[[Path], Path]) -> Cost:
    """The cost of a file: it is made in a fork, and read in another one, where libraries are imported already.

    Args:
        kind: of the file.
        name: of the way in which it grows.
        make: writes it into a folder that has a right file of each kind.
    """
    with tempfile.TemporaryDirectory(prefix="carts-growing-") as folder:
        made = _forked(lambda: str(make(Path(folder))))
        if made["result"] != "read":
            raise RuntimeError(f"{kind} {name} was not made: {made['detail']}")
        path = Path(made["value"])
        size = path.stat().st_size if path.is_file() else sum(file.stat().st_size for file in path.iterdir())
        seen = _forked(lambda: repr(READERS[kind](path))[:200])
    memory = seen["memory"]
    result = seen["result"]
    if result in ("read", "refused"):
        result = "slow" if seen["seconds"] > SECONDS else "memory" if memory > max(MEMORY, size) else result
    return Cost(kind, name, result, size, seen["seconds"], memory, seen["detail"])


def _forked(work: Callable[[], str]) -> dict:
    """Result of a function in a child process, with its time and memory."""
    here, there = os.pipe()
    if (child := os.fork()) == 0:
        os.close(here)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        signal.alarm(PATIENCE)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start, value, detail = time.process_time(), "", ""
        try:
            value, result = work(), "read"
        except CartsError as error:
            result, detail = "refused", str(error)
            if len(detail) > 5000:
                result, detail = "traceback", f"a message of {len(detail)} characters"
        except BaseException:
            result, detail = "traceback", traceback.format_exc()[-1500:]
        from carts_core.files import decoding  # noqa: PLC0415

        decoding._end()  # Children count once they have been waited for.
        own, children = (resource.getrusage(which) for which in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        seconds = time.process_time() - start + children.ru_utime + children.ru_stime
        memory = 1024 * max(0, own.ru_maxrss - before) + max(0, 1024 * children.ru_maxrss - INTERPRETER)
        answer = {"result": result, "value": value, "detail": detail, "seconds": seconds, "memory": memory}
        os.write(there, msgspec.json.encode(answer)[:60_000])
        os._exit(0)
    os.close(there)
    with os.fdopen(here, "rb") as pipe:
        content = pipe.read()
    _, status = os.waitpid(child, 0)
    if not content:
        usage = {"seconds": float(PATIENCE), "memory": 0, "value": "", "detail": f"status {status}"}
        return {"result": "died", **usage}
    return json.loads(content)


def main() -> None:
    """Measure files and print a line for each; status 1 if any is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", help="KIND/NAME; every file of every kind if none is given")
    arguments = parser.parse_args()
    right_folder()
    costs = []
    for kind in CASES:
        made = {"right": RIGHT[kind], **CASES[kind]}
        for name, make in made.items():
            if arguments.cases and f"{kind}/{name}" not in arguments.cases:
                continue
            cost = measured(kind, name, make)
            costs.append(cost)
            print(
                f"{kind:12} {name:24} {cost.result:9} {cost.size / 1e6:8.3f} MB {cost.seconds:6.2f} s "
                f"{cost.memory / 2**20:7.1f} MiB  {cost.detail.strip() if cost.wrong else cost.detail[:160]!r}",
                flush=True,
            )
    wrong = sum(cost.wrong for cost in costs)
    print(f"{len(costs)} files, {wrong} wrong")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
