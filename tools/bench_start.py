"""Benchmark of `carts view` from the start of its process to the first overlay in a tab.

    python -m tools.bench_start [SEQUENCE] [--times 5]

The first start is not counted: it fills the caches of kernels and meshes. The tab uses the page's protocol without a
browser, and connects as soon as the address is printed.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carts_core.resources import sample_sequence
from tools.raw_tab import RawTab

_LONGEST = 120.0
"""Timeout [s]."""


@dataclass(frozen=True)
class Start:
    """Times of one start, from the start of the process [s]."""

    address: float
    """Time until the address is printed."""
    overlay: float
    """Time until the first overlay arrives."""
    processor: float
    """Processor time of the process until the first overlay."""


def measured_start(sequence: Path) -> Start:
    """Start the command with a new project, connect its first tab, and end it.

    Raises:
        RuntimeError: the command did not start.
    """
    command = [sys.executable, "-m", "carts_core.cli", "view", str(sequence), "--port", "0", "--project"]
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        with subprocess.Popen([*command, f"{folder}/bench.carts"], stdout=subprocess.PIPE, text=True) as process:
            try:
                url = _address(process)
                address = time.perf_counter() - began
                with RawTab(url) as tab:
                    while not tab.overlays:
                        if time.perf_counter() - began > _LONGEST:
                            raise RuntimeError(f"No overlay came within {_LONGEST:g} s.")
                        time.sleep(0.001)
                    processor = _processor_time(process.pid)
                    return Start(address, tab.overlays[0][0] - began, processor)
            finally:
                process.terminate()
                process.communicate()


def _address(process: "subprocess.Popen[str]") -> str:
    """Output of the command when the page is served."""
    assert process.stdout is not None
    for line in process.stdout:
        if (found := re.search(r"Open (http\S+)", line)) is not None:
            return found[1]
    raise RuntimeError("`carts view` ended before the page was there.")


def _processor_time(process: int) -> float:
    """Processor time of all threads [s]; NaN if the system does not provide it."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def print_starts(sequence: Path, times: int = 5) -> None:
    """Measure several starts, and print the results, with the load of the machine before and after."""
    load = os.getloadavg()[0]
    starts = [measured_start(sequence) for _ in range(times + 1)][1:]
    print(f"carts view, {times} times, load {load:.1f} to {os.getloadavg()[0]:.1f}, from the start of the process")
    for name, seconds in (
        ("to its address", [start.address for start in starts]),
        ("to the first overlay in a tab", [start.overlay for start in starts]),
        ("processor time of that", [start.processor for start in starts]),
    ):
        print(f"  {name}: median {np.median(seconds):.2f}, least {min(seconds):.2f}, most {max(seconds):.2f} s")


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", type=Path, default=sample_sequence())
    parser.add_argument("--times", type=int, default=5)
    arguments = parser.parse_args()
    print_starts(arguments.sequence, arguments.times)


if __name__ == "__main__":
    main()
