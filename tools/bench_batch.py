"""Time and memory of a batch folder with many finished jobs: manifest, list of jobs, states, report and page.

python -m tools.bench_batch [--jobs 10000] [--frames 20]
"""

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from carts_core.batch.folder import (
    FINDINGS_FILE,
    JOB_FILE,
    Findings,
    FrameFinding,
    JobState,
    StepState,
    known_jobs,
    write_jobs,
)
from carts_core.batch.manifest import Job, read_manifest
from carts_core.batch.report import write_batch_report
from carts_core.files import OutputPath, output_path
from carts_viewer.start.batch_page import BatchPage
from tools.memory import resident_megabytes

_JOINTS = [f"psm{arm}.joint{joint}" for arm in (1, 2) for joint in range(7)]
_STATUSES = ["done"] * 17 + ["failed", "stopped", "running"]
"""Statuses of the jobs, in turn; a running job without its process is *lost*."""


def make_batch(folder: Path, jobs: int, frames: int) -> Path:
    """Write recordings, a manifest, and a batch folder with the results of all jobs; returns the manifest."""
    draw = np.random.default_rng(0)
    for number in range(jobs):
        recording = folder / "archive" / f"case{number:05d}"
        recording.mkdir(parents=True)
        (recording / "sequence.toml").write_text("# Simulated.\n")
        path = output_path(folder / "batch") / "jobs" / recording.name
        status = cast(Any, _STATUSES[number % len(_STATUSES)])
        path.path.mkdir(parents=True)
        state = JobState(status, {"sequence": StepState("0" * 64, 12.5)}, 1, worker="node:1", heartbeat=1e9)
        (path.path / JOB_FILE).write_text(json.dumps(asdict(state)))
        if status != "done":
            continue
        verdicts = draw.choice(["good", "doubtful", "failed"], frames, p=[0.9, 0.07, 0.03])
        found = Findings(
            str(recording / "sequence.toml"),
            [
                FrameFinding("left", f"{frame:06d}", str(verdict), "The fit is good.", round(float(draw.random()), 4))
                for frame, verdict in enumerate(verdicts)
            ],
            {name: draw.normal(0.0, 1.0, frames).round(6).tolist() for name in _JOINTS},
            {name: draw.uniform(0.1, 0.3, frames).round(6).tolist() for name in _JOINTS},
            {f"psm{arm} in left": np.eye(4).tolist() for arm in (1, 2)},
        )
        (path.path / FINDINGS_FILE).write_text(json.dumps(asdict(found)))
    manifest = folder / "archive.toml"
    manifest.write_text(
        'format = "carts-batch/1"\n\n[[jobs]]\nrecordings = ["archive/*/sequence.toml"]\nsteps = ["sequence"]\n'
    )
    return manifest


class _Shown:
    """Host of a page whose document is only counted [bytes]."""

    def __init__(self) -> None:
        self.document = self
        self.size = 0

    def show(self, content: str) -> None:
        self.size = len(content)

    def post(self, function: Callable[[], None]) -> None:
        """Updates are not measured."""


def timed(name: str, function: Callable[[], Any]) -> Any:
    """Call a function, and print its time and the memory of the process."""
    began, before = time.perf_counter(), time.process_time()
    found = function()
    seconds, processor = time.perf_counter() - began, time.process_time() - before
    print(f"  {name}: {seconds:.2f} s, processor {processor:.2f} s; {resident_megabytes():.0f} MB", flush=True)
    return found


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=10_000)
    parser.add_argument("--frames", type=int, default=20)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        batch: OutputPath = output_path(folder / "batch")
        manifest = make_batch(folder, arguments.jobs, arguments.frames)
        print(f"{arguments.jobs} jobs of {arguments.frames} frames, load {os.getloadavg()[0]:.1f}")
        jobs: list[Job] = timed("read the manifest", lambda: read_manifest(manifest, batch.path))
        timed("write the list of jobs", lambda: write_jobs(batch, jobs))
        timed("read states and results", lambda: len(known_jobs(batch, jobs)))
        timed("report", lambda: write_batch_report(batch, "Batch", jobs))
        page = timed("open the page", lambda: BatchPage(cast(Any, _Shown()), batch.path))
        timed("show the page", page.show)
        timed("update the page", page.show)
        page.close()
    print(f"  peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main()
