"""Ctrl-C, SIGTERM and SIGHUP end a command in the same way, between two steps."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from processes import command, descendants, eventually

from carts_core.rendering.rasterizer import rasterize
from carts_core.stopping import Stopped, exit_status, finished_first, message, message_if_stopped, stopped_by_signals

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.mark.parametrize("number", SIGNALS)
def test_each_signal_stops_with_the_status_that_shells_have_for_it(number: signal.Signals) -> None:
    with pytest.raises(Stopped) as stop, stopped_by_signals(), message_if_stopped("2 of 3 frames are kept"):
        os.kill(os.getpid(), number)
    assert exit_status(stop.value) == 128 + number
    by = "interrupted" if number == signal.SIGINT else f"stopped by {number.name}"
    assert message(stop.value) == f"{by}; 2 of 3 frames are kept"


def test_what_was_begun_is_finished_before_the_stop() -> None:
    done = []
    with pytest.raises(Stopped), stopped_by_signals():
        with finished_first():
            with finished_first():
                os.kill(os.getpid(), signal.SIGTERM)
                done.append("inner")
            done.append("outer")
        done.append("never")
    assert done == ["inner", "outer"]


def test_a_signal_that_is_ignored_stays_ignored_as_under_nohup() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopped_by_signals():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_forked_child_ends_by_the_signal_itself() -> None:
    code = """
import os, signal, time
from carts_core.stopping import stopped_by_signals
with stopped_by_signals():
    ready, begun = os.pipe()
    if not (child := os.fork()):
        os.write(begun, b"!")
        time.sleep(60)
    os.read(ready, 1)
    os.kill(child, signal.SIGTERM)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (ran.stdout.strip(), ran.stderr) == ("-15", "")


_SIGNAL_IN_CALLBACK = """
import os, signal, sys, time
from test_stopping import draw
from carts_core.stopping import stopped_by_signals

def calls(frame, event, argument):
    if frame.f_code.co_name == "_raw_object_cache_getbuffer":
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGTERM)

with stopped_by_signals():
    sys.setprofile(calls)
    draw()
    time.sleep(30)
"""


def draw() -> None:
    """Draw a triangle."""
    corners = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0]])
    rasterize(corners, np.array([[0, 1, 2]]), [50.0, 50.0, 20.0, 20.0], 40, 40)


def test_a_signal_while_a_kernel_is_loaded_stops_when_it_is_loaded() -> None:
    # What LLVM calls back cannot raise: the exception is lost, and the process ends with SIGSEGV.
    draw()
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path}
    command = [sys.executable, "-c", _SIGNAL_IN_CALLBACK]
    ran = subprocess.run(command, check=False, capture_output=True, text=True, timeout=250, env=environment)
    assert ran.returncode == 1 and ran.stderr.endswith("Stopped: SIGTERM\n"), (ran.returncode, ran.stderr)


def test_a_signal_in_an_import_or_a_finalizer_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send = f"import os\nos.kill(os.getpid(), {int(signal.SIGTERM)})\n"
    (tmp_path / "imported_while_stopped.py").write_text(send + "whole = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Stopped), stopped_by_signals():
        import imported_while_stopped  # pyright: ignore[reportMissingImports]  # noqa: PLC0415

        assert imported_while_stopped.whole
        time.sleep(30)

    class Finalized:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            sum(range(10))

    with pytest.raises(Stopped), stopped_by_signals():
        Finalized()
        time.sleep(30)


def test_a_signal_in_a_library_waits_for_its_end_but_not_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    for patience, seconds in ((10.0, 1.0), (0.3, 30.0)):
        monkeypatch.setattr("carts_core.stopping._PATIENCE", patience)
        ends = []
        with pytest.raises(Stopped), stopped_by_signals():
            timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM))
            timer.start()
            threading.Event().wait(seconds)
            ends.append(seconds)
            time.sleep(30)
        assert ends == ([seconds] if patience > seconds else [])


TRAINING = (
    "--steps 100000 --batch-size 1 --workers 1 --threads 1 --validation-samples 2 --images.width 64 "
    "--images.height 48 --images.field-width 64"
)
PARENTS = {
    "training": f"""
import sys, time
from carts_viewer.jobs.work import _Training
training = _Training([sys.argv[1], *"{TRAINING}".split()])
time.sleep(600)
""",
    "batch": """
import time
from pathlib import Path
from carts_core.batch.engines import Pool
def work(job):
    time.sleep(600)
if __name__ == "__main__":
    list(Pool(work, 1, 1).run([Path("a job")]))
""",
    "cluster": """
import time
from pathlib import Path
from carts_core.batch.engines import LOCAL, Cluster
def work(job):
    time.sleep(600)
if __name__ == "__main__":
    list(Cluster(work, LOCAL, 1, 1).run([Path("a job")]))
""",
    "decoding": """
import time
from carts_core.files.decoding import Decoder, Limits
Decoder().call(time.sleep, 600, limits=Limits(seconds=60))
""",
    "decimation": """
import numpy as np
from carts_core.model.decimation import decimated
random = np.random.default_rng(0)
decimated(random.random((300_000, 3)), random.integers(0, 300_000, (300_000, 3)), 1e-3)
""",
}
"""Programs that start a child process."""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("parent", "children"),
    [
        pytest.param("training", 3, marks=pytest.mark.slow),
        *(("batch", 2), ("cluster", 2), ("decoding", 1), ("decimation", 1)),
    ],
)
def test_child_processes_end_when_their_parent_is_killed(parent: str, children: int, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(PARENTS[parent])
    program = subprocess.Popen([sys.executable, str(script), str(tmp_path / "run")])
    eventually(lambda: len(descendants(program.pid)) >= children)
    started = descendants(program.pid)
    program.kill()
    program.wait()
    eventually(lambda: not any(map(command, started)))
