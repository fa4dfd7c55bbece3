"""What a program of ours asks of the machine."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from carts_core.model.mesh_cache import cache_dir, read
from carts_core.project.identity import data_dir

TUNED = "from carts_core.process import tune_process; tune_process()"

FAULTS = """
import resource
import torch
{tune}
def images():
    return [torch.zeros(4, 640, 480) + index for index in range(8)]
for _ in range(10):
    images()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(100):
    images()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(tune: str, **malloc: str) -> int:
    """How often the system had to hand out memory while images were made and dropped in a process of its own."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | malloc
    ran = subprocess.run(
        [sys.executable, "-c", FAULTS.format(tune=tune)], capture_output=True, text=True, check=True, env=environment
    )
    return int(ran.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's allocator can be told to keep memory")
def test_memory_of_images_is_kept_and_not_asked_for_anew() -> None:
    # Untuned, glibc asks for anything from none to all of it anew, as the heap happens to end; this has it ask for all.
    anew = page_faults("", MALLOC_MMAP_THRESHOLD_="131072")
    assert anew > 500_000
    assert page_faults(TUNED) < 0.01 * anew


KEPT = """
import os, threading
import numpy as np
from carts_core.process import return_memory, tune_process
tune_process()
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
def work(done, end):
    images = [np.ones(10_000) for _ in range(500)]
    del images
    done.release()
    end.wait()
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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators have no such heaps")
def test_threads_share_heaps_and_freed_memory_is_returned_on_request() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    ran = subprocess.run([sys.executable, "-c", KEPT], capture_output=True, text=True, check=True, env=environment)
    kept, returned = map(float, ran.stdout.split())
    # Each of the eight has used 40 MB, one after the other.
    assert kept < 160 and returned < 20


@pytest.mark.parametrize(("given", "expected"), [({"OMP_NUM_THREADS": "2"}, 2), ({}, None)])
def test_a_core_is_left_to_others_unless_the_environment_says_how_many(
    given: dict[str, str], expected: int | None
) -> None:
    code = f"import torch; {TUNED}; print(torch.get_num_threads())"
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")} | given
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert int(ran.stdout) == (expected or max(1, min((os.cpu_count() or 2) - 1, 4)))


UNWRITABLE = """
import numba.core.caching as caching
caching.CacheImpl._locator_classes = []  # As where neither the installation nor the home folder can be written to.
import carts_core.rendering, carts_core.optimization.factors.edges
from carts_core.compiled import compiled

@compiled
def twice(value):
    return 2 * value

print(twice(21))
"""


def test_kernels_are_compiled_without_a_cache_where_none_can_be_written_and_one_line_says_so() -> None:
    found = subprocess.run([sys.executable, "-c", UNWRITABLE], capture_output=True, text=True, check=True)
    assert found.stdout == "42\n"
    (line,) = found.stderr.splitlines()
    assert line.startswith("note: compiled functions cannot be kept") and "NUMBA_CACHE_DIR" in line


def test_the_caches_have_a_place_for_a_user_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HOME", "CARTS_CACHE", "XDG_CACHE_HOME", "CARTS_DATA", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)

    def nobody(number: int) -> None:
        raise KeyError(number)

    monkeypatch.setattr("pwd.getpwuid", nobody)
    assert cache_dir() == Path("/.cache/carts") and data_dir() == Path("/.local/share/carts")
    assert read("no such key") is None
