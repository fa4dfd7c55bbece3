"""`carts bench`: measure all methods on frames that nothing was tuned on, and write the report."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ..console import Terminal
from ..errors import CartsError
from ..stopping import when_stopped
from ..wording import counted
from .selection import Network, output_folder

if TYPE_CHECKING:
    from ..lab.baselines.networks import TrainedBaseline


@dataclass(frozen=True)
class Bench:
    """Measure accuracy and speed of all methods, and write a report; run it again to go on after a stop."""

    output: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of the report; by default `runs/bench/quick` or `runs/bench/full`."""
    quick: bool = False
    """Few frames and steps: some minutes instead of hours."""
    real: Path | None = None
    """Sequence file with real frames and masks, to be measured too, also with their instruments in other rooms."""
    rooms: Path | None = None
    """Folder of photographs to put instruments before, besides made rooms."""
    report_only: bool = False
    """Measure nothing; write the report of what is there."""
    frames: int | None = None
    """Frames of each sequence to evaluate, if not as many as usual."""
    seed: int | None = None
    """Seed of the synthetic sequence, if not the usual one."""
    baselines: tuple[Path, ...] = ()
    """Weights files of `carts baseline`: networks of others, a row each, evaluated on the frames of the main table."""
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)

    def run(self) -> None:
        """Measure what is not known yet and write the report."""
        from importlib.metadata import version

        from ..lab.benchmark import FULL, QUICK, TEST_SEED, Benchmark, Facts, ResultsFile, plan, write_report
        from ..lab.benchmark.hand_eye import known_hand_eye, measure_hand_eye
        from ..lab.benchmark.measurement import code_fingerprint
        from ..lab.benchmark.sources import (
            family_sources,
            real_source,
            room_sources,
            synthetic_room_source,
            synthetic_source,
        )
        from ..lab.benchmark.timing import known_stages, measure_stages

        console = Terminal()
        scope = QUICK if self.quick else FULL
        if self.frames is not None:
            scope = scope.with_frames(self.frames)
        name = "quick" if self.quick else "full"
        folder = output_folder(self.output, "bench", name)
        seed = TEST_SEED if self.seed is None else self.seed
        extractor = self.network.load()
        made = synthetic_source(scope, seed)
        sources = [made, synthetic_room_source(made, self.rooms, scope, seed), *family_sources(scope, seed)]
        if self.real is not None:
            sources += [real_source(self.real, scope, seed), *room_sources(self.real, self.rooms, scope, seed)]
        baselines = self._baselines()
        runs = plan(scope, sources, list(baselines))
        results = ResultsFile(folder / "measurements.jsonl")
        benchmark = Benchmark(scope, sources, extractor, results, runs, baselines)
        if results.unreadable:
            console.print(f"{results.path}: {counted(results.unreadable, 'torn line')} left out and measured again")
        stages, hand_eye = folder / "stages.json", folder / "hand_eye.json"
        if not self.report_only:
            with when_stopped(f"{results.path} holds what was measured; the same command goes on from there"):
                benchmark.run(console)
                measure_stages(stages, extractor)
                measure_hand_eye(hand_eye, extractor, scope.hand_eye_starts, console.print)
        measurements = benchmark.measurements()
        if not measurements:
            raise CartsError(
                f"{results.path} holds no measurement of these settings, weights and code. Run without --report-only."
            )
        facts = Facts(
            scope=name,
            planned=len(runs),
            sources={source.name: source.description for source in sources},
            weights=extractor.fingerprint,
            code=code_fingerprint(),
            version=version("carts"),
        )
        calibrations = known_hand_eye(hand_eye, extractor)
        page = write_report(folder, measurements, facts, known_stages(stages, extractor), calibrations)
        console.print(f"wrote {page} ({len(measurements)} of {counted(len(runs), 'run')})")

    def _baselines(self) -> "dict[str, TrainedBaseline]":
        """Row -> network."""
        from ..lab.baselines.networks import read_baseline

        found: dict[str, TrainedBaseline] = {}
        for path in self.baselines:
            trained = read_baseline(path)
            if trained.row in found:
                raise CartsError(
                    f"--baselines names two files of the row {trained.row}; {path} is the second. Give one of each "
                    "network and augmentation, and the other in a run of its own."
                )
            found[trained.row] = trained
        return found
