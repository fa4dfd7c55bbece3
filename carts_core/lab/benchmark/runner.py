"""Plan of a benchmark's runs, and the runner of those that are not measured yet."""

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Items
from dataclasses import replace
from itertools import product

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn

from ...console import Bar, PlainColumn
from ...model.scene import Scene
from ...networks.extractor import FeatureExtractor
from ...optimization import Backgrounds, FreeParameters, MaskPredictor
from ...recording import Frame
from ...rendering import Renderer
from ...settings import DOMAINS, DescentSolver
from ...wording import counted
from ..baselines.networks import TrainedBaseline
from .conditions import (
    CROSSING,
    OCCLUSION,
    OTHER_INSTRUMENT,
    WRONG,
    crossed,
    misled,
    occlude,
    with_other_instruments,
    wrong_inputs,
)
from .frame import (
    Truth,
    calibrated_scene,
    correct_forwards,
    correct_together,
    optimize,
    segment,
)
from .measurement import Measurement, ResultsFile, code_fingerprint, run_fingerprint
from .scope import FAMILY, MAIN, METHODS, REAL, RENDERING, ROOMS, SYNTHETIC, Run, Scope
from .sources import Recording, Source

_UNDER_OCCLUDERS = ("ours", "ours_given", "ours_proposed")


def plan(scope: Scope, sources: Items[Source], baselines: Items[str] = ()) -> list[Run]:
    """All runs, frame after frame, so that a stopped benchmark has some measurements of every kind.

    Frames on which not all methods are evaluated come after that, then frames that are corrected together, other rooms,
    and instruments that no training has. `baselines` are names in `scope.BASELINES` whose weights are given.
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
    together = [name for name, method in METHODS.items() if method.together]
    runs += [
        Run(source.name, domain, frame, method, error)
        for source in sources
        for error in (None, *(scope.consecutive_errors_deg if source.name == SYNTHETIC else ()))
        for domain in scope.consecutive_domains
        for method in together
        for frame in source.consecutive
    ]
    runs += [run for source in rooms for run in _runs_in_rooms(source)]
    return runs + [
        Run(source.name, domain, frame, "ours", error)
        for source in families
        for frame in source.frames
        for domain in source.domains
        for error in scope.hard_errors_deg
    ]


def _runs_in_rooms(source: Source) -> list[Run]:
    return [
        Run(source.name, room, frame, method)
        for room in source.rooms
        for method, frames in (("ours", source.frames), ("acs", source.frames), ("sequence", source.consecutive))
        for frame in frames
    ]


def _runs_of_frame(scope: Scope, source: Source, frame: int, baselines: Items[str]) -> list[Run]:
    runs = [Run(source.name, domain, frame, method) for domain in DOMAINS for method in (*MAIN, RENDERING, *baselines)]
    if source.name == SYNTHETIC:
        domains, ours, papers, hard = (
            scope.error_domains,
            scope.errors_deg,
            scope.paper_errors_deg,
            scope.hard_errors_deg,
        )
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
        # One calibration serves the whole recording, and scoring it costs next to nothing.
        return [Run(source.name, "regular", frame, "calibrated")]
    return [
        Run(source.name, domain, frame, "ours", error)
        for error in scope.further_errors_deg
        for domain in scope.error_domains
    ]


_OCCLUDERS_SEED = 20


class Benchmark:
    """The runs of a scope over some sources, and the file of their results.

    Args:
        scope: of the benchmark.
        sources: of frames.
        extractor: the networks.
        results: the file.
        runs: to be measured, in this order.
        baselines: name in `scope.BASELINES` -> its network; every baseline among the runs.
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
        self.runs = {run: self._fingerprint(run) for run in runs}

    def measurements(self) -> list[Measurement]:
        """Stored measurements of the runs."""
        found = (self.results.find(run, fingerprint) for run, fingerprint in self.runs.items())
        return [measurement for measurement in found if measurement is not None]

    def run(self, console: Console) -> None:
        """Measure the missing runs; a stopped benchmark keeps its measurements.

        Raises:
            CartsError: a sequence cannot be made or read, or the results cannot be written.
        """
        todo = {run: key for run, key in self.runs.items() if self.results.find(run, key) is None}
        if not todo:
            return
        columns = (
            PlainColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Bar(*columns, console=console, disable=not console.is_terminal) as bar:
            bench = {name: SourceBench(source, bar, self.baselines) for name, source in self.sources.items()}
            task = bar.add_task("measuring", total=len(self.runs), completed=len(self.runs) - len(todo))
            while todo:
                run = next(iter(todo))
                group = self._group(run)
                error = "" if run.error_deg is None else f", {run.error_deg:g} deg off"
                which = f"frame {run.frame}" if len(group) == 1 else counted(len(group), "frame")
                description = f"{run.source}, {run.domain}, {which}: {run.method}{error}"
                bar.update(task, description=description)
                for measurement in bench[run.source].measure(group, self.scope, self.extractor):
                    facts = {"weights": self.extractor.fingerprint, "code": code_fingerprint()}
                    self.results.append(measurement, self.runs[measurement.run], **facts)
                    bar.advance(task, todo.pop(measurement.run, None) is not None)
                _log(console, f"{len(self.runs) - len(todo)} of {len(self.runs)}: {description}")
            bar.update(task, description="measured")

    def _fingerprint(self, run: Run) -> str:
        baseline = self.baselines[run.method].sha256 if METHODS[run.method].baseline else None
        return run_fingerprint(run, self.scope, self.extractor, self.sources[run.source].fingerprint, baseline)

    def _group(self, run: Run) -> list[Run]:
        """Runs that are measured together with this one."""
        if not METHODS[run.method].together:
            return [run]
        return [other for other in self.runs if replace(other, frame=run.frame) == run]


def _log(console: Console, line: str) -> None:
    """Print progress to a file or a pipe."""
    if not console.is_terminal:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


class SourceBench:
    """A source, opened at its first run."""

    def __init__(self, source: Source, bar: Bar, baselines: Mapping[str, TrainedBaseline] | None = None) -> None:
        self._source, self._bar, self._baselines = source, bar, baselines or {}
        self.opened: tuple[Recording, Renderer] | None = None
        """The recording and its renderer, once it is open."""
        self._calibrated: Scene | None = None

    def measure(self, runs: list[Run], scope: Scope, extractor: FeatureExtractor) -> list[Measurement]:
        """Measure a run, or all runs of one method that corrects frames together."""
        if not METHODS[runs[0].method].together:
            return [self._measure_alone(runs[0], scope, extractor)]
        recording, renderer = self._open()
        truths = {run.frame: self._truth(recording.frame(run.frame, cameras=[self._source.camera])) for run in runs}
        settings = METHODS[runs[0].method].settings
        first = settings(scope.steps(runs[0])) if settings else None
        if isinstance(first, DescentSolver):
            return correct_forwards(runs, recording, extractor, truths, renderer, first)
        return correct_together(runs, recording, extractor, truths, renderer)

    def _measure_alone(self, run: Run, scope: Scope, extractor: FeatureExtractor) -> Measurement:
        recording, renderer = self._open()
        method, camera = METHODS[run.method], self._source.camera
        cameras = self._source.cameras if method.every_camera else (camera,)
        covered, wrong, crossing = run.domain == OCCLUSION, run.domain in WRONG, run.domain == CROSSING
        if wrong:
            frame = misled(recording, run.domain, run.frame, camera)
        elif crossing:
            frame = crossed(recording, run.frame, camera)
        else:
            frame = recording.frame(run.frame, None if covered else run.domain, cameras)
        truth = self._truth(frame)
        if covered:
            frame, truth = self._covered(frame, truth)
        if method.settings is None:
            return segment(run, recording.scene, frame, truth, extractor, self._baselines.get(run.method))
        settings = method.settings(scope.steps(run))
        domain = "regular" if covered or wrong or crossing else run.domain
        if method.masks_given:
            networks, backgrounds = MaskPredictor(), Backgrounds({})
        else:
            networks = extractor
            backgrounds = Backgrounds.of(recording, cameras, domain, required=settings.needs_background)
        ignore = {camera: truth.hidden} if method.occluders_given and truth.hidden is not None else None
        known = self._calibration(scope, extractor) if method.calibrated else recording.scene
        if run.domain == OTHER_INSTRUMENT:
            known = with_other_instruments(known, run.frame)
            renderer = Renderer(known, cameras=[camera])
        scene = known.with_cameras(cameras)
        free = FreeParameters(extrinsics=method.poses, locked_cameras=(camera,))
        return optimize(run, scene, frame, backgrounds, networks, settings, free, truth, renderer, ignore)

    def _truth(self, frame: Frame) -> Truth:
        recording, _ = self._open()
        assert frame.masks is not None
        camera = self._source.camera
        return Truth(camera, frame.masks[camera], frame.truth or {}, recording.measured_joints)

    def _covered(self, frame: Frame, truth: Truth) -> tuple[Frame, Truth]:
        rng = np.random.default_rng((_OCCLUDERS_SEED, frame.index))
        found = occlude(frame.images[truth.camera], truth.mask, rng)
        return replace(frame, images={truth.camera: found.image}), replace(truth, hidden=found.hidden)

    def _calibration(self, scope: Scope, extractor: FeatureExtractor) -> Scene:
        if self._calibrated is None:
            recording, _ = self._open()
            description = f"calibrating with {counted(scope.calibration_frames, 'frame')}"
            task = self._bar.add_task(description, total=None)
            _log(self._bar.console, f"{self._source.name}: {description}")
            self._calibrated = calibrated_scene(recording, self._source.camera, scope.calibration_frames, extractor)
            self._bar.remove_task(task)
        return self._calibrated

    def _open(self) -> tuple[Recording, Renderer]:
        if self.opened is None:
            task = self._bar.add_task("opening", total=None)

            def report(what: str, done: int, total: int) -> None:
                self._bar.update(task, description=what, completed=done, total=total)
                _log(self._bar.console, f"{self._source.name}: {what}, {done} of {total}")

            recording = self._source.open(report)
            self._bar.remove_task(task)
            self.opened = recording, Renderer(recording.scene, cameras=[self._source.camera])
        return self.opened
