"""Threads and memory of the process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from carts_core import process
from carts_core.model.mesh_cache import cache_dir, read
from carts_core.process import tune_process
from carts_core.project.identity import data_dir


@pytest.mark.parametrize(("given", "expected"), [("2", 2), (None, max(1, min((os.cpu_count() or 2) - 1, 4)))])
def test_a_core_is_left_to_others(given: str | None, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    monkeypatch.setattr(process._TUNED, "core_left_free", False)
    torch.set_num_threads(2)
    tune_process()
    assert torch.get_num_threads() == expected


UNWRITABLE = """
import numba.core.caching as caching
caching.CacheImpl._locator_classes = []  # As where neither the installation nor the home folder can be written to.
from carts_core.compiled import compiled

@compiled
def twice(value):
    return 2 * value

@compiled
def four_times(value):
    return twice(twice(value))

print(four_times(10) + 2)
"""


def test_kernels_are_compiled_without_a_cache_where_none_can_be_written_and_one_line_says_so() -> None:
    found = subprocess.run([sys.executable, "-c", UNWRITABLE], capture_output=True, text=True, check=True)
    assert found.stdout == "42\n"
    (line,) = found.stderr.splitlines()
    assert line.startswith("note: compiled functions cannot be cached") and "NUMBA_CACHE_DIR" in line


def test_the_caches_have_a_place_for_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HOME", "CARTS_CACHE", "XDG_CACHE_HOME", "CARTS_DATA", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)

    def nobody(number: int) -> None:
        raise KeyError(number)

    monkeypatch.setattr("pwd.getpwuid", nobody)
    assert cache_dir() == Path("/.cache/carts") and data_dir() == Path("/.local/share/carts")
    assert read("no such key") is None
