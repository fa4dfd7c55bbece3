"""What a program of ours asks of the machine."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from carts_core.model.mesh_cache import cache_dir, read
from carts_core.process import tune_process
from carts_core.project.identity import data_dir

PAGE_FAULTS = """
import os, resource, threading
import numpy as np
{tune}
def faults(repetitions):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(repetitions):
        [np.zeros((4, 640, 480), np.float32) + index for index in range(8)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults(10)
print(faults(10))
"""
RETURNED = """
from carts_core.process import return_memory
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
def work(done, end):
    images = [np.ones(10_000) for _ in range(500)]
    del images
    done.release()
    end.wait()
return_memory()
start, done, end = resident(), threading.Semaphore(0), threading.Event()
threads = [threading.Thread(target=work, args=(done, end)) for _ in range(8)]
for thread in threads:
    thread.start()
    done.acquire()
print(resident() - start)
last = [np.ones(10_000) for _ in range(2000)][-1]
return_memory()
print(resident() - start)
end.set()
"""


def printed(code: str, **environment: str) -> list[float]:
    """Numbers that a process prints whose environment tunes nothing else."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "OMP_"))}
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=kept | environment
    )
    return [float(word) for word in ran.stdout.split()]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's allocator can be told to keep memory")
def test_memory_of_images_is_kept_shared_by_threads_and_returned_on_request() -> None:
    # Untuned, glibc asks for anything from none to all of it anew, as the heap happens to end; this has it ask for all.
    (anew,) = printed(PAGE_FAULTS.format(tune=""), MALLOC_MMAP_THRESHOLD_="131072")
    assert anew > 50_000
    tune = "from carts_core.process import tune_process\ntune_process()"
    again, kept, returned = printed(PAGE_FAULTS.format(tune=tune) + RETURNED, OMP_NUM_THREADS="1")
    assert again < 0.02 * anew
    # Each of the eight threads has used 40 MB, one after the other.
    assert kept < 160 and returned < 20


@pytest.mark.parametrize(("given", "expected"), [("2", 2), (None, max(1, min((os.cpu_count() or 2) - 1, 4)))])
def test_a_core_is_left_to_others_unless_the_environment_says_how_many(
    given: str | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
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
