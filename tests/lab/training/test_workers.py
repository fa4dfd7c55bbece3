"""Processes that make training images: they outlive signals to the group, and end with the run."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from carts_core.lab.training.loop import CHECKPOINT_FILE, load_checkpoint

_RUN = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_training import small_config
from carts_core.lab.training.training import train
from carts_core.stopping import stopped_by_signals
with stopped_by_signals():
    train(small_config(steps=int(sys.argv[3]), workers=1), Path(sys.argv[1]))
"""


def begun(folder: Path, steps: int) -> subprocess.Popen[bytes]:
    """A run with a worker, in a process group of its own."""
    arguments = [sys.executable, "-c", _RUN, str(folder), str(Path(__file__).parent), str(steps)]
    return subprocess.Popen(arguments, start_new_session=True)


def test_a_run_with_workers_keeps_its_steps_after_a_signal_to_the_group_and_ends_when_it_is_done(tmp_path: Path):
    process = begun(tmp_path, 100_000)
    try:
        deadline = time.monotonic() + 240
        while not (tmp_path / CHECKPOINT_FILE).is_file():
            assert process.poll() is None and time.monotonic() < deadline, "no checkpoint was written"
            time.sleep(0.2)
        os.killpg(process.pid, signal.SIGTERM)
        assert process.wait(120) != 0
    finally:
        process.kill()
        process.wait()
    stopped = load_checkpoint(tmp_path)
    assert stopped is not None and stopped.step >= 5
    process = begun(tmp_path, stopped.step + 3)
    try:
        assert process.wait(240) == 0
    finally:
        process.kill()
        process.wait()
    ended = load_checkpoint(tmp_path)
    assert ended is not None and ended.step == stopped.step + 3
