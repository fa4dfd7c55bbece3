"""Does the runs that are not known yet, one after the other."""

from collections.abc import Iterable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ..features.extractor import FeatureExtractor
from ..rendering import Renderer
from .fingerprints import code_fingerprint, run_fingerprint
from .frame import Truth, optimize, segment
from .measurement import Measurement
from .methods import METHODS
from .plan import Run, Scope
from .sources import Recording, Source
from .store import ResultsFile


class Benchmark:
    """The runs of a scope over some sources, and the file that holds their results.

    Args:
        scope: how much is measured.
        sources: where frames come from.
        extractor: the feature network.
        results: the results file.
        runs: what is measured, in order.
    """

    def __init__(
        self,
        scope: Scope,
        sources: Iterable[Source],
        extractor: FeatureExtractor,
        results: ResultsFile,
        runs: Iterable[Run],
    ) -> None:
        self.scope, self.extractor, self.results = scope, extractor, results
        self.sources = {source.name: source for source in sources}
        self.runs = {run: run_fingerprint(run, scope, extractor, self.sources[run.source].fingerprint) for run in runs}

    def measurements(self) -> list[Measurement]:
        """What is known of the runs."""
        found = (self.results.find(run, fingerprint) for run, fingerprint in self.runs.items())
        return [measurement for measurement in found if measurement is not None]

    def run(self, console: Console) -> None:
        """Measure what is not known yet; stopping at any moment keeps what was measured.

        Raises:
            CartsError: a sequence cannot be made or read, or the results cannot be written.
        """
        todo = {run: key for run, key in self.runs.items() if self.results.find(run, key) is None}
        if not todo:
            return
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console) as bar:
            bench = {name: _Bench(source, bar) for name, source in self.sources.items()}
            task = bar.add_task("measuring", total=len(self.runs), completed=len(self.runs) - len(todo))
            for run, key in todo.items():
                error = "" if run.error_deg is None else f", {run.error_deg:g} deg off"
                bar.update(task, description=f"{run.source}, {run.domain}, frame {run.frame}: {run.method}{error}")
                measurement = bench[run.source].measure(run, self.scope, self.extractor)
                facts = {"weights": self.extractor.sha256, "code": code_fingerprint()}
                self.results.append(measurement, key, **facts)
                bar.advance(task)
            bar.update(task, description="measured")


class _Bench:
    """One source, opened when its first run comes."""

    def __init__(self, source: Source, bar: Progress) -> None:
        self._source, self._bar = source, bar
        self._opened: tuple[Recording, Renderer] | None = None

    def measure(self, run: Run, scope: Scope, extractor: FeatureExtractor) -> Measurement:
        recording, renderer = self._open()
        camera = self._source.camera
        frame = recording.frame(run.frame, run.domain, [camera])
        assert frame.masks is not None
        truth = Truth(frame.masks[camera], frame.truth or {}, recording.measured_joints)
        make_settings = METHODS[run.method].settings
        if make_settings is None:
            return segment(run, frame.images[camera], extractor, truth)
        background = {camera: recording.background(camera, run.domain)}
        settings = make_settings(scope.paper_iterations)
        return optimize(run, renderer.scene, frame, background, extractor, settings, truth, renderer)

    def _open(self) -> tuple[Recording, Renderer]:
        if self._opened is None:
            task = self._bar.add_task("opening", total=None)
            recording = self._source.open(
                lambda what, done, total: self._bar.update(task, description=what, completed=done, total=total)
            )
            self._bar.remove_task(task)
            self._opened = recording, Renderer(recording.scene, cameras=[self._source.camera])
        return self._opened
