"""Plan of the runs of a benchmark, and the runner that measures missing runs."""

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Items
from dataclasses import replace
from itertools import product

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn

from ...console import Bar, PlainColumn
from ...networks.extractor import FeatureExtractor
from ...settings import DOMAINS
from ...wording import counted
from ..baselines.networks import TrainedBaseline
from .conditions import CROSSING, OCCLUSION, wrong_inputs
from .frame import SourceBench, log
from .measurement import Measurement, ResultsFile, code_fingerprint, run_fingerprint
from .scope import FAMILY, MAIN, METHODS, REAL, RENDERING, ROOMS, SYNTHETIC, Run, Scope
from .sources import Source

_UNDER_OCCLUDERS = ("ours", "ours_given", "ours_proposed")


def plan(scope: Scope, sources: Items[Source], baselines: Items[str] = ()) -> list[Run]:
    """Plan all runs, ordered by frame, so that a stopped benchmark has measurements of every kind.

    These runs are followed by frames with a subset of the methods, frames corrected together, other rooms, and
    instruments absent from the training data. `baselines` are the names in `scope.BASELINES` with given weights.
    """
    rooms, families = ([s for s in sources if s.name.startswith(kind)] for kind in (ROOMS, FAMILY))
    sources = [source for source in sources if source not in (*rooms, *families)]
    runs: list[Run] = []
    for turn in range(max((len(source.frames) for source in sources), default=0)):
        for source in sources:
            if turn < len(source.frames):
                runs += _runs_of_frame(scope, source, source.frames[turn], baselines)
    for source in sources:
        for frame in source.further:
            runs += _runs_of_further_frame(scope, source, frame)
    together = [name for name, method in METHODS.items() if method.as_sequence]
    runs += [
        Run(source.name, domain, frame, method, error)
        for source in sources
        for error in (None, *(scope.consecutive_errors_deg if source.name == SYNTHETIC else ()))
        for domain in scope.consecutive_domains
        for method in together
        for frame in source.consecutive
    ]
    runs += [
        Run(source.name, room, frame, method)
        for source in rooms
        for room in source.rooms
        for method, frames in (("ours", source.frames), ("acs", source.frames), ("sequence", source.consecutive))
        for frame in frames
    ]
    return runs + [
        Run(source.name, domain, frame, "ours", error)
        for source in families
        for frame in source.frames
        for domain in source.domains
        for error in scope.hard_errors_deg
    ]


def _runs_of_frame(scope: Scope, source: Source, frame: int, baselines: Items[str]) -> list[Run]:
    runs = [Run(source.name, domain, frame, method) for domain in DOMAINS for method in (*MAIN, RENDERING, *baselines)]
    if source.name == SYNTHETIC:
        domains, hard = scope.error_domains, scope.hard_errors_deg
        ours, papers = scope.errors_deg, scope.paper_errors_deg
    else:
        domains, ours, papers, hard = ("regular",), scope.real_errors_deg, scope.real_errors_deg, ()
    runs += [Run(source.name, domain, frame, "ours", error) for error in ours for domain in domains]
    runs += [Run(source.name, "regular", frame, "paper", error) for error in papers]
    if source.name == SYNTHETIC:
        crossing = product(scope.crossing_errors_deg, ("ours", "acs"))
        runs += [Run(source.name, CROSSING, frame, method, error) for error, method in crossing]
    wrong = wrong_inputs(source.length, len(source.cameras), built_in=source.name == SYNTHETIC)
    runs += [Run(source.name, kind, frame, "ours") for kind in wrong]
    for error in (None, *hard):
        runs += [Run(source.name, "regular", frame, "masks", error)]
        runs += [Run(source.name, OCCLUSION, frame, method, error) for method in _UNDER_OCCLUDERS]
        if len(source.cameras) > 1:
            runs += [Run(source.name, "regular", frame, method, error) for method in ("stereo", "stereo_posed")]
    if source.name == REAL:
        runs += [Run(source.name, "regular", frame, method) for method, entry in METHODS.items() if entry.calibrated]
    return runs


def _runs_of_further_frame(scope: Scope, source: Source, frame: int) -> list[Run]:
    if source.name == REAL:
        # The whole recording shares one calibration, and scoring takes little time.
        return [Run(source.name, "regular", frame, "calibrated")]
    return [
        Run(source.name, domain, frame, "ours", error)
        for error in scope.further_errors_deg
        for domain in scope.error_domains
    ]


class Benchmark:
    """Benchmark of the runs of a scope on sources, and file of results.

    Runs are measured in the given order. `baselines` maps names in `scope.BASELINES` to networks and must contain all
    baselines of the runs.
    """

    def __init__(
        self,
        scope: Scope,
        sources: Iterable[Source],
        extractor: FeatureExtractor,
        results: ResultsFile,
        runs: Iterable[Run],
        baselines: Mapping[str, TrainedBaseline] | None = None,
    ) -> None:
        self.scope, self.extractor, self.results = scope, extractor, results
        self.baselines = dict(baselines or {})
        self.sources = {source.name: source for source in sources}
        self.runs: dict[Run, str] = {}
        """Run -> fingerprint."""
        for run in runs:
            baseline = self.baselines[run.method].sha256 if METHODS[run.method].baseline else None
            source = self.sources[run.source].fingerprint
            self.runs[run] = run_fingerprint(run, scope, extractor, source, baseline)

    def measurements(self) -> list[Measurement]:
        """Stored measurements of the runs."""
        found = (self.results.find(run, fingerprint) for run, fingerprint in self.runs.items())
        return [measurement for measurement in found if measurement is not None]

    def run(self, console: Console) -> None:
        """Measure the missing runs; measurements are kept if the benchmark is stopped.

        Raises:
            CartsError: a sequence cannot be generated or read, or the results cannot be written.
        """
        todo = {run: key for run, key in self.runs.items() if self.results.find(run, key) is None}
        if not todo:
            return
        columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        with Bar(PlainColumn("{task.description}"), *columns, console=console, disable=not console.is_terminal) as bar:
            bench = {
                name: SourceBench(source, bar, self.scope, self.extractor, self.baselines)
                for name, source in self.sources.items()
            }
            task = bar.add_task("measuring", total=len(self.runs), completed=len(self.runs) - len(todo))
            while todo:
                run = next(iter(todo))
                group = self._group(run)
                error = "" if run.error_deg is None else f", {run.error_deg:g} deg error"
                which = f"frame {run.frame}" if len(group) == 1 else counted(len(group), "frame")
                description = f"{run.source}, {run.domain}, {which}: {run.method}{error}"
                bar.update(task, description=description)
                for measurement in bench[run.source].measure(group):
                    facts = {"weights": self.extractor.fingerprint, "code": code_fingerprint()}
                    self.results.append(measurement, self.runs[measurement.run], **facts)
                    bar.advance(task, todo.pop(measurement.run, None) is not None)
                log(console, f"{len(self.runs) - len(todo)} of {len(self.runs)}: {description}")
            bar.update(task, description="measured")

    def _group(self, run: Run) -> list[Run]:
        """Runs that are measured together with this run."""
        if not METHODS[run.method].as_sequence:
            return [run]
        return [other for other in self.runs if replace(other, frame=run.frame) == run]
