"""`carts batch`: pipelines over many recordings, on one or several machines."""

import math
import os
import shlex
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..console import Bar, Terminal
from ..errors import CartsError
from ..package_imports import gc_paused
from ..settings.ranges import Count, Range
from ..stopping import message_if_stopped
from ..wording import counted, duration_text
from .options import RangedOptions, output_folder

if TYPE_CHECKING:
    from ..batch.manifest import Job
    from ..files import OutputPath
    from ..settings.optimization import Engine

_BETWEEN_SUMMARIES = 1.0
"""Minimum interval between updates of throughput and cost [s]."""
_FEW = 100
"""Number of finished jobs up to which throughput and cost are updated after each job."""
_NAMED = 5
"""Maximum number of failed jobs named in the final message."""


@dataclass(frozen=True)
class Batch(RangedOptions):
    """Import, calibrate, optimize, evaluate and export many recordings in parallel; rerun it to resume."""

    manifest: Annotated[Path, tyro.conf.Positional]
    """Manifest of recordings, cameras, domains and steps (docs: batch)."""
    output: Path | None = None
    """Output folder; by default `runs/batch/NAME`, where NAME is that of the manifest. Each job has its own folder in
    `jobs`."""
    workers: Annotated[int, Range(0)] = 0
    """Number of parallel jobs; by default the number of cores."""
    threads: Count = 1
    """Number of threads per job. One thread is most efficient if there are more jobs than cores."""
    shard: str = "1/1"
    """Shard `I/N`: run every N-th job, starting with the I-th. Machines that share the folder can run one shard
    each."""
    scheduler: str | None = None
    """Run jobs with dask.distributed: address of its scheduler, or `local` for workers on this machine."""
    project: Literal["beside", "none"] = "beside"
    """Corrections for jobs that only evaluate or export: `beside` for the project beside the recording, or `none`."""
    again: bool = False
    """Run finished steps again; `optimize` and `sequence` recompute only results whose inputs have changed."""
    report_only: bool = False
    """Only write the report, without running jobs."""

    def run(self) -> None:
        """Run the jobs of the shard, and write the report if these are all jobs; `CartsError` if a job failed."""
        from ..batch.folder import write_jobs
        from ..batch.manifest import read_manifest, shard
        from ..batch.report import write_batch_report

        console = Terminal()
        folder = output_folder(self.output, "batch", self.manifest.stem)
        with gc_paused():
            jobs = read_manifest(self.manifest, folder.path)
            chosen = shard(jobs, self.shard)
            if not self.report_only:
                from .batch_job import check_options  # Imports all commands.

                check_options(jobs)
            write_jobs(folder, jobs)
        failed: dict[str, str] = {}
        with message_if_stopped(f"{folder} holds the finished jobs; rerun the command to resume"):
            if not self.report_only:
                failed = self._run(console, chosen, folder)
            if self.report_only or len(chosen) == len(jobs):
                console.print(f"wrote {write_batch_report(folder, f'CaRTS batch {self.manifest.stem}', jobs)}")
        if not self.report_only and len(chosen) < len(jobs):
            console.print("this shard is done; after the last shard, write the report with --report-only")
        console.print(f"to inspect the results: carts view {folder}{_roots(jobs, folder.path)}")
        if failed:
            lines = {name: (error.strip() or "unknown cause").splitlines()[-1] for name, error in failed.items()}
            named = "".join(f"\n  {name}: {line}" for name, line in list(lines.items())[:_NAMED])
            raise CartsError(
                f"{len(failed)} of {counted(len(chosen), 'job')} failed; rerun the command to retry. Their logs "
                f"are in {folder / 'jobs'}.{named}"
            )

    def _run(self, console: Terminal, jobs: "list[Job]", folder: "OutputPath") -> dict[str, str]:
        """Run jobs; returns job name -> error of the failed jobs."""
        from ..batch.cost import Cost, JobCost
        from ..batch.engines import Pool
        from ..package_imports import require_package
        from .batch_job import BatchWork, with_project

        work = BatchWork(folder, self.again, _inference(folder), self.project)
        workers = min(self.workers or os.cpu_count() or 1, len(jobs))
        if self.scheduler is None:
            engine = Pool(work, workers, self.threads)
        else:
            require_package("distributed", "cluster")
            from ..batch.engines import Cluster

            engine = Cluster(work, self.scheduler, workers, self.threads)
        if self.project == "beside" and (those := sum(with_project(job) is not None for job in jobs)):
            counts_of = f"{those} of {counted(len(jobs), 'job')} use the project beside the recording"
            console.print(f"{counts_of} (see the logs). To use the measured joints: --project none")
        failed, counts, done = {}, Counter(), []
        began, shown, summary = time.monotonic(), -math.inf, ""
        columns = Bar.get_default_columns()[:-1]  # The last one would include jobs done earlier in its estimate.
        with Bar(*columns, console=console) as bar:
            task = bar.add_task("jobs", total=len(jobs))
            for outcome in engine.run(jobs):
                counts[outcome.status] += 1
                if outcome.status == "failed":
                    failed[outcome.job] = outcome.error
                if outcome.status == "done":
                    done.append(JobCost(outcome.seconds, outcome.processor, outcome.frames))
                left = len(jobs) - counts.total()
                if time.monotonic() - shown > _BETWEEN_SUMMARIES or len(done) <= _FEW or not left:
                    shown, running = time.monotonic(), min(engine.workers, left)
                    summary = Cost(tuple(done), left, running).summary(running or engine.workers)
                parts = ["jobs", f"{counts['failed']} failed", summary]
                bar.update(task, advance=1, description=", ".join(filter(None, parts)))
        words = {"done": "done", "known": "done earlier", "busy": "run by another process", "failed": "failed"}
        console.print(", ".join(f"{counts[status]} {words[status]}" for status in words if counts[status]))
        if done:
            cost, seconds = Cost(tuple(done), 0), time.monotonic() - began
            rate = f", {cost.frames / seconds:.3g} frames/s" if cost.frames else ""
            console.print(
                f"{counted(len(done), 'job')} with {counted(cost.frames, 'frame')} in {duration_text(seconds)} on "
                f"{counted(engine.workers, 'worker')}{rate}, {cost.core_hours:.3g} core hours"
            )
            console.print(f"estimates for these jobs: {cost.forecast()}")
        return failed


def _roots(jobs: "list[Job]", folder: Path) -> str:
    """Option that allows the page to open recordings outside of the current folder and of the batch's folder."""
    allowed = (f"{Path.cwd()}{os.sep}", f"{folder.absolute()}{os.sep}")
    parents = {os.path.dirname(job.recording) for job in jobs}
    outside = [parent for parent in parents if not f"{parent}{os.sep}".startswith(allowed)]
    common = os.path.commonpath(outside) if outside else os.sep
    # Folders without a common parent are left to the user.
    return "" if common == os.sep else f" --root {shlex.quote(common)}"


def _inference(folder: "OutputPath") -> "Engine":
    """Inference engine of all jobs: the fastest engine on the machine that started the batch."""
    from ..files import holds_file, write_new
    from ..files.reading import SETTINGS, read_text
    from ..process import tune_process

    path = folder / "inference.txt"
    if not holds_file(path):
        # Imported here, because it imports PyTorch, which a resumed batch does not need.
        from ..networks.extractor import FeatureExtractor

        tune_process()
        write_new(path, FeatureExtractor.load(inference="auto").engine.encode())
    found = read_text(path.path, SETTINGS)
    return "int8" if found == "int8" else "onnx" if found == "onnx" else "torch"
