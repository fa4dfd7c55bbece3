"""Runs commands in forked processes and sends each a signal after a while: a process a second instead of ten.

Reads requests from standard input, a JSON object a line: `arguments` of the command, `log` for what it prints, and
`seconds` after which it gets `signal`, or `sign`, a file at whose first change it gets it. Answers each with a line:
the exit status, negative if a signal ended it.
"""

import faulthandler
import json
import os
import sys
import threading
from pathlib import Path

from carts_core.cli import calibrate, export, lab, main, optimizing
from carts_core.lab.training import training
from carts_core.optimization import CalibrationOptimizer, SequenceOptimizer

LOADED = (calibrate, export, lab, optimizing, training, CalibrationOptimizer, SequenceOptimizer)
"""So that no child has to import what all of them need."""


def run(arguments: list[str], log: Path) -> int:
    """The command's exit status."""
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    # A crash says where.
    faulthandler.enable(2)
    try:
        main(arguments)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def serve() -> None:
    """Answer requests until there are no more."""
    for line in sys.stdin:
        request = json.loads(line)
        child = os.fork()
        if child == 0:
            status = 1
            try:
                status = run(request["arguments"], Path(request["log"]))
            finally:
                os._exit(status)
        # The child stays until it was waited for, so its number is nobody else's while it gets the signal.
        ended = threading.Event()
        sender = threading.Thread(target=send, args=(child, request, ended))
        sender.start()
        os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
        ended.set()
        sender.join()
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


def send(child: int, request: dict, ended: threading.Event) -> None:
    """Send a signal to a child at its time, unless it has ended before."""
    if request["sign"] is None:
        ended.wait(request["seconds"])
    else:
        sign = Path(request["sign"])
        before = size(sign)
        while size(sign) in (before, None) and not ended.wait(0.01):
            pass
    if not ended.is_set():
        os.kill(child, request["signal"])


def size(path: Path) -> int | None:
    """How large a file is [bytes]; None where there is none."""
    return path.stat().st_size if path.exists() else None


if __name__ == "__main__":
    serve()
