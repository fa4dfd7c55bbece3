"""Small files that grow when they are read are refused, or read in bounded time and memory, without a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.growing_files import CASES

QUICK = {
    "yaml": ("aliases", "tags"),
    "ini": ("blanks",),
    "npy": ("false length",),
    "parquet": ("dictionary of texts",),
    "bag": ("merge keys",),
    "dae": ("instances",),
    "glb": ("zeros",),
}


def _wrong(*arguments: str, seconds: float) -> str:
    """What a process of its own, whose memory is not that of the tests, finds wrong with files of some kinds."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])}
    command = [sys.executable, "-m", "fuzz.growing", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds, env=environment)
    return "" if done.returncode == 0 else done.stdout + done.stderr


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in QUICK.items() for name in names])
def test_a_file_that_grows_costs_little(kind: str, name: str) -> None:
    assert name in CASES[kind]
    assert not _wrong("--kinds", kind, "--only", name, seconds=120)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_files_of_every_kind_that_grow_cost_little() -> None:
    assert not _wrong(seconds=7000)
