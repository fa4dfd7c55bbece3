"""Time and memory of a batch folder with many recordings: the report and the page, each in its own process.

    python -m tools.bench_batch [--jobs 10000] [--frames 20] [--times 3] [--code CHECKOUT ...] [--no-page] [--engines]

The folder contains the files that workers write. Commands of several checkouts are measured in turn. The page is
measured in Chromium (`CARTS_CHROMIUM` or on the path), which is started before.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
import numpy as np
from playwright.sync_api import Browser, sync_playwright

from carts_core.batch.engines import Cluster, Outcome, Pool
from carts_core.batch.folder import FINDINGS_FILE, JOB_FILE, Findings, FrameFinding, JobState, StepState
from carts_core.batch.manifest import Job
from carts_core.resources import sample_sequence
from tools.memory import resident_megabytes

_JOINTS = [f"psm{arm}.joint{joint}" for arm in (1, 2) for joint in range(7)]
_STATUSES = ["done"] * 17 + ["failed", "stopped", "running"]
"""Statuses of the jobs, in turn; a running job without its process is *lost*."""
_CHANGED = 100
"""Number of jobs that change between two reports or updates of the page."""
_WORST = 3
"""Number of pictures per job."""


def make_batch(folder: Path, jobs: int, frames: int) -> Path:
    """Write recordings, a manifest, and a batch folder with the results of all jobs; returns the manifest."""
    draw = np.random.default_rng(0)
    picture = _picture()
    for number in range(jobs):
        recording = folder / "archive" / f"case{number:05d}"
        recording.mkdir(parents=True)
        (recording / "sequence.toml").write_text("# Simulated.\n")
        place = folder / "batch" / "jobs" / recording.name
        place.mkdir(parents=True)
        _write_job(place, recording / "sequence.toml", _STATUSES[number % len(_STATUSES)], frames, draw, picture)
    manifest = folder / "archive.toml"
    manifest.write_text(
        'format = "carts-batch/1"\n\n[[jobs]]\nrecordings = ["archive/*/sequence.toml"]\nsteps = ["sequence"]\n'
    )
    return manifest


def _picture() -> bytes:
    image = cv2.resize(np.random.default_rng(0).integers(0, 255, (9, 16, 3), np.uint8), (480, 270))
    return cv2.imencode(".jpg", image)[1].tobytes()


def _write_job(
    place: Path, recording: Path, status: str, frames: int, draw: np.random.Generator, picture: bytes
) -> None:
    """Write the files of a job, without the synchronization to disk of the workers."""
    error = (
        "Traceback of a job\n" * 20 + "SettingsError: the domain is not in the sequence." if status == "failed" else ""
    )
    state = JobState(cast(Any, status), {"sequence": StepState("0" * 64, 12.5)}, 1, error, "node:1", 1e9)
    _replace(place / JOB_FILE, json.dumps(asdict(state), indent=1).encode())
    _replace(place / "sequence.log", b"Simulated.\n")
    if status != "done":
        return
    verdicts = draw.choice(["good", "doubtful", "failed"], frames, p=[0.9, 0.07, 0.03])
    probabilities = draw.random(frames).round(4)
    worst = {int(frame): f"worst-left-{frame:06d}.jpg" for frame in np.argsort(-probabilities)[:_WORST]}
    for name in worst.values():
        _replace(place / name, picture)
    found = Findings(
        str(recording),
        [
            FrameFinding("left", f"{frame:06d}", str(verdict), "The fit is good.", chance, worst.get(frame, ""))
            for frame, (verdict, chance) in enumerate(zip(verdicts, probabilities.tolist(), strict=True))
        ],
        {name: draw.normal(0.0, 1.0, frames).round(6).tolist() for name in _JOINTS},
        {name: draw.uniform(0.1, 0.3, frames).round(6).tolist() for name in _JOINTS},
        {f"psm{arm} in left": np.eye(4).tolist() for arm in (1, 2)},
    )
    _replace(place / FINDINGS_FILE, msgspec.json.encode(found))


def _replace(path: Path, content: bytes) -> None:
    """Write a file as workers do: under another name, then renamed."""
    beside = path.with_name(f".{path.name}.new")
    beside.write_bytes(content)
    beside.replace(path)


def change_jobs(folder: Path, jobs: int, frames: int, seed: int) -> None:
    """Replace the results of some jobs, spread over the archive."""
    picture = _picture()
    draw = np.random.default_rng(seed)
    for number in draw.choice(jobs, min(_CHANGED, jobs), replace=False):
        name = f"case{number:05d}"
        place = folder / "batch" / "jobs" / name
        _write_job(place, folder / "archive" / name / "sequence.toml", "done", frames, draw, picture)


class Code:
    """A checkout whose commands are measured, on its own copy of the archive."""

    def __init__(self, checkout: Path, archive: Path) -> None:
        self.checkout, self.archive = checkout.resolve(), archive
        self.environment = {**os.environ, "PYTHONPATH": str(self.checkout), "OMP_NUM_THREADS": "1"}
        self.rows: dict[str, list[tuple[float, float, float]]] = {}
        """Measurement -> time, processor time [s] and peak memory [MB] of each repetition."""

    def command(self, *arguments: object) -> list[str]:
        """Command line of a subcommand of `carts`."""
        return [sys.executable, "-m", "carts_core.cli", *map(str, arguments)]

    def report(self) -> None:
        """Measure the command that writes the report, from the start of its process to its end."""
        command = self.command(
            "batch", self.archive / "archive.toml", "--output", self.archive / "batch", "--report-only"
        )
        began = time.perf_counter()
        process = subprocess.Popen(command, cwd=self.checkout, env=self.environment, stdout=-3, stderr=-3)
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
        if os.waitstatus_to_exitcode(status) != 0:
            raise RuntimeError(f"{' '.join(command)} failed in {self.checkout}.")
        self.note("report", seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3)

    def page(self, browser: Browser, change: Callable[[], None]) -> None:
        """Measure the page from the start of its process to the list of jobs in a tab, and an update after a change."""
        began = time.perf_counter()
        with self._served(began) as (process, url):
            tab = browser.new_page(viewport={"width": 1280, "height": 800})
            opened = time.perf_counter()
            tab.goto(url)
            tab.locator(".jobs tbody tr").first.wait_for()
            self.note("page: list of jobs after the start of the process", time.perf_counter() - began, *_use(process))
            self.note("page: list of jobs after the address", time.perf_counter() - opened, *_use(process))
            before = tab.locator("main p").first.inner_text()
            change()
            used = _use(process)[0]
            began = time.perf_counter()
            tab.get_by_role("button", name="Refresh").click()
            tab.wait_for_function("text => document.querySelector('main p').innerText !== text", arg=before)
            seconds = time.perf_counter() - began
            after, peak = _use(process)
            self.note("page: update after a change", seconds, after - used, peak)
            tab.close()

    @contextmanager
    def _served(self, began: float) -> Iterator[tuple[int, str]]:
        """Process and address of the page."""
        command = self.command("view", self.archive / "batch", "--port", 0)
        with subprocess.Popen(
            command, cwd=self.checkout, env=self.environment, stdout=subprocess.PIPE, text=True
        ) as process:
            try:
                assert process.stdout is not None
                url = next(found[1] for line in process.stdout if (found := re.search(r"Open (http\S+)", line)))
                self.note("page: address", time.perf_counter() - began, *_use(process.pid))
                yield process.pid, url
            finally:
                process.terminate()
                process.communicate()

    def note(self, name: str, seconds: float, processor: float, megabytes: float) -> None:
        """Keep and print a measurement."""
        self.rows.setdefault(name, []).append((seconds, processor, megabytes))
        print(
            f"  {self.checkout.name}: {name}: {seconds:.2f} s, processor {processor:.2f} s, {megabytes:.0f} MB",
            flush=True,
        )


def _use(process: int) -> tuple[float, float]:
    """Processor time [s] and peak memory [MB] of a running process."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    peak = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{process}/status").read_text())
    assert peak is not None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), int(peak[1]) / 1e3


def no_work(job: Job) -> Outcome:
    """Outcome of a job that does nothing."""
    return Outcome(job.name, "done")


def measure_engines(jobs: int) -> None:
    """Print the time that each engine takes to distribute jobs which do nothing, and the memory of this process."""
    listed = [Job(f"case{number:05d}", Path("sequence.toml"), "all", "", ("sequence",)) for number in range(jobs)]
    for name, engine in (("pool", Pool(no_work, 2, 1)), ("dask", Cluster(no_work, "local", 2, 1))):
        began, before = time.perf_counter(), time.process_time()
        done = sum(outcome.status == "done" for outcome in engine.run(listed))
        seconds, processor = time.perf_counter() - began, time.process_time() - before
        memory = resident_megabytes()
        print(f"  {name}, {done} jobs: {seconds:.2f} s, processor {processor:.2f} s, {memory:.0f} MB", flush=True)


def measure_gain(jobs: int, times: int, recording: Path) -> None:
    """Print how much faster two workers process jobs than one, relative to two plain commands in parallel."""
    plain: list[tuple[float, float]] = []
    batch: list[tuple[float, float]] = []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as name:
            manifest, sequence = Path(name) / "archive.toml", str(recording.resolve())
            table = f'[[jobs]]\nrecordings = ["{sequence}"]\nsteps = ["sequence"]\n'
            manifest.write_text(f'format = "carts-batch/1"\n{jobs * table}')
            for in_batch, rows in ((False, plain), (True, batch)):
                seconds = []
                for count in (1, 2):
                    output = f"{name}/{in_batch}{count}"
                    commands = [
                        [
                            "optimize",
                            sequence,
                            "--output",
                            f"{output}-{number}",
                            "--mode",
                            "sequence",
                            "--camera",
                            "all",
                        ]
                        for number in range(jobs)
                    ]
                    if in_batch:
                        seconds.append(
                            _elapsed([["batch", str(manifest), "--output", output, "--workers", str(count)]])
                        )
                    else:
                        seconds.append(_elapsed(*(commands[first::count] for first in range(count))))
                rows.append((seconds[0], seconds[1]))
                what = "batch" if in_batch else "plain commands"
                gain = seconds[0] / seconds[1]
                print(f"  {what}: one {seconds[0]:.1f} s, two {seconds[1]:.1f} s, gain {gain:.3f}", flush=True)
    gains = [float(np.median([one / two for one, two in rows])) for rows in (batch, plain)]
    print(f"  gain of two workers {gains[0]:.3f}, of two plain commands {gains[1]:.3f}: {gains[0] / gains[1]:.3f}")
    print(f"  two workers need {np.median([b[1] / p[1] for b, p in zip(batch, plain, strict=True)]):.3f} of their time")


def _elapsed(*rows: list[list[str]]) -> float:
    """Duration of rows of commands [s]; rows run in parallel, and commands use one thread."""

    def script(row: list[list[str]]) -> str:
        return " && ".join(shlex.join([sys.executable, "-m", "carts_core.cli", *command]) for command in row)

    began, environment = time.perf_counter(), {**os.environ, "OMP_NUM_THREADS": "1"}
    running = [subprocess.Popen(script(row), shell=True, env=environment, stdout=-3, stderr=-3) for row in rows]
    if any([process.wait() for process in running]):
        raise RuntimeError("a command failed")
    return time.perf_counter() - began


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=10_000)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--code", type=Path, nargs="+", default=[Path(__file__).parents[1]])
    parser.add_argument("--no-page", action="store_true")
    parser.add_argument("--engines", action="store_true")
    parser.add_argument("--recording", type=Path, default=sample_sequence(), help="recording of the jobs of --gain")
    parser.add_argument("--gain", type=int, metavar="JOBS", help="only measure two workers against two plain commands")
    arguments = parser.parse_args()
    if arguments.gain:
        print(f"{arguments.gain} jobs, load {os.getloadavg()[0]:.1f}", flush=True)
        return measure_gain(arguments.gain, arguments.times, arguments.recording)
    with tempfile.TemporaryDirectory() as name:
        codes = []
        for number, checkout in enumerate(arguments.code):
            archive = Path(name) / str(number)
            make_batch(archive, arguments.jobs, arguments.frames)
            codes.append(Code(checkout, archive))
        print(f"{arguments.jobs} jobs of {arguments.frames} frames, load {os.getloadavg()[0]:.1f}", flush=True)
        with sync_playwright() as playwright:
            chromium = os.environ.get("CARTS_CHROMIUM") or shutil.which("chromium")
            browser = None if arguments.no_page else playwright.chromium.launch(executable_path=chromium)
            for seed, code in enumerate(arguments.times * codes, 1):
                code.report()
                if browser is not None:
                    code.page(
                        browser,
                        lambda code=code, seed=seed: change_jobs(code.archive, arguments.jobs, arguments.frames, seed),
                    )
            if browser is not None:
                browser.close()
    if arguments.engines:
        measure_engines(arguments.jobs)
    print(f"medians, load {os.getloadavg()[0]:.1f}")
    for name in codes[0].rows:
        for code in codes:
            values = np.median(code.rows[name], axis=0)
            print(f"  {name}, {code.checkout.name}: {values[0]:.2f} s, processor {values[1]:.2f} s, {values[2]:.0f} MB")


if __name__ == "__main__":
    main()
