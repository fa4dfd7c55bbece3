"""Small files that grow when they are read are refused, or read in bounded time and memory, without a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

QUICK = ["npz/false small size", "mat/bomb", "bag/endless view"]


def check(*cases: str, seconds: float) -> str:
    """Function that reads files in a separate process, with separate memory; returns the output."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    command = [sys.executable, "-m", "fuzz.growing", *cases]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_file_that_grows_costs_little() -> None:
    assert f"{len(QUICK)} files, 0 wrong" in check(*QUICK, seconds=250)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_files_of_every_kind_that_grow_cost_little() -> None:
    check(seconds=7000)
