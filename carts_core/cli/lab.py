"""`carts synthesize`, `carts train`, `carts baseline` and `carts bench`: the commands of `carts_core.lab`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.progress import TimeRemainingColumn

from ..console import Bar, Terminal
from ..errors import CartsError
from ..files import output_path
from ..settings import SynthesisConfig, TrainingConfig
from ..settings.ranges import Count
from ..settings.training import ADAPTATION_SETTINGS, BaselineNetwork, BaselineTraining
from ..stopping import message_if_stopped
from ..wording import counted
from .options import Network, RangedOptions, check_device, output_folder

if TYPE_CHECKING:
    from ..lab.baselines.networks import TrainedBaseline


@dataclass(frozen=True)
class Synthesize:
    """Path-trace a synthetic sequence of two instruments (or one arm of another robot) over tissue in all domains, with
    true and measured kinematics.
    """

    output: Annotated[Path, tyro.conf.Positional]
    """Folder to create, which must not exist."""
    synthesis: Annotated[SynthesisConfig, tyro.conf.arg(name="")] = field(default_factory=SynthesisConfig)

    def run(self) -> None:
        """Write the sequence."""
        from ..lab.synthesis.synthesize import synthesize

        with Bar() as bar:
            task = bar.add_task("synthesizing", total=None)
            with message_if_stopped("finished frames are kept beside the output; rerun the command to resume"):
                path = synthesize(
                    self.synthesis,
                    self.output,
                    lambda what, done, total: bar.update(task, description=what, completed=done, total=total),
                )
        bar.console.print(f"wrote {path}")


@dataclass(frozen=True)
class Train(RangedOptions):
    """Train a network on synthetic images; rerun it to resume after an interruption."""

    output: Annotated[Path, tyro.conf.Positional] = Path("runs/train")
    """Folder for checkpoints, weights and the training report."""
    for_: Annotated[Path | None, tyro.conf.arg(name="for", metavar="SEQUENCE")] = None
    """Sequence file whose robots, cameras, distances and empty backgrounds the network is adapted to. Training stops
    when validation no longer improves, or after `--steps` or `--minutes` of CPU time; if neither is given, after 400
    steps. The weights are accepted if no metric of the fits gets worse. `--for SEQUENCE --help` shows the defaults.
    """
    fits: Count = 8
    """With `--for`: number of synthetic images for the comparison of fits; half as many frames of the recording are
    added.
    """
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)

    def run(self) -> None:
        """Train the network, and print the results."""
        from ..lab.training.training import TrainingProgress, train

        check_device(self.training.device)
        console = Terminal()
        if self.for_ is not None:
            self._adapt(self.for_, console)
            return
        with Bar(*Bar.get_default_columns()[:-1], TimeRemainingColumn(), console=console) as bar:
            task = bar.add_task("training", total=self.training.steps)

            def report(progress: TrainingProgress) -> None:
                text = f"loss {progress.loss:.3f}, {progress.seconds_per_step:.2f} s per step"
                bar.update(task, completed=progress.step, total=progress.steps, description=text)

            result = train(self.training, self.output, report)
        console.print(f"weights: {result.weights}\nreport:  {result.report}\n{result.validation}")

    def _adapt(self, recording: Path, console: Terminal) -> None:
        """Adapt the shipped network, or that of `--start`, to a recording; the weights are accepted if no metric of
        the fits is worse."""
        from ..lab.training.adaptation import adapted_to, gain, offer
        from ..lab.training.training import TrainingProgress, train

        said: dict[str, float] | None = None
        with Bar(*Bar.get_default_columns()[:-1], TimeRemainingColumn(), console=console, transient=True) as bar:
            task = bar.add_task("reading the recording", total=None)
            config = adapted_to(recording, self.output, self.training)

            def report(progress: TrainingProgress) -> None:
                nonlocal said
                text = f"step {progress.step}" if progress.step else "training"
                bar.update(task, completed=progress.step, total=progress.steps, description=text)
                if progress.validation is None or progress.first is None or progress.validation is said:
                    return
                said = progress.validation
                console.print(f"step {progress.step}: {gain(progress.first, said)}", soft_wrap=True)

            bar.update(task, description="making validation images")
            result = train(config, self.output, report)

            def compare(text: str, done: int, total: int) -> None:
                bar.update(task, completed=done, total=total, description=text)

            found = offer(config, result, compare, made=self.fits, own=max(1, self.fits // 2))
        console.print(f"report:  {result.report}")
        if result.first is not None:
            console.print(f"best weights: {gain(result.first, result.validation)}", soft_wrap=True)
        if result.validation.get("step") == 0:
            console.print("No step improved the validation, so the initial weights were kept.")
        for line in found.lines:
            console.print(line, soft_wrap=True)
        if found.worse:
            console.print(f"rejected because of worse results: {'; '.join(found.worse)}", soft_wrap=True)
            console.print(f"The weights are in {found.weights}. Continue to use the previous network.", soft_wrap=True)
            return
        console.print(f"weights: {found.weights}")
        console.print(f"To use them: carts optimize {recording} --weights {found.weights}", soft_wrap=True)


@dataclass(frozen=True)
class Adapt(Train):
    """`carts train --for`: the network is adapted to a recording, with other defaults."""

    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=lambda: ADAPTATION_SETTINGS)


@dataclass(frozen=True)
class BaselineOptions(BaselineNetwork):
    """Architecture of a baseline; its input has the size of the training frames."""

    size: tyro.conf.Suppress[tuple[int, int]] = BaselineNetwork.size


@dataclass(frozen=True)
class Baseline:
    """Train one of the networks of `carts bench --baselines`; rerun the command to resume."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder for checkpoints and weights."""
    frames: Path = Path("runs/baseline_frames")
    """Folder of training frames, shared by all baselines; missing frames are created."""
    network: Annotated[BaselineOptions, tyro.conf.arg(name="")] = field(default_factory=BaselineOptions)
    training: BaselineTraining = field(default_factory=BaselineTraining)
    """Settings of the training."""

    def run(self) -> None:
        """Train the network, and print the results."""
        from ..lab.baselines.training import prepare_frames, train_baseline

        check_device(self.training.device)
        console = Terminal()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)

        with message_if_stopped(f"{self.output} holds the state of the training; rerun the command to resume"):
            frames = prepare_frames(output_path(self.frames), self.training, say)
            result = train_baseline(self.network, self.training, frames, self.output, say)
        say(f"weights: {result.weights}\n{result.steps} steps, Dice {result.dice:.3f} on validation frames")


DataSet = Literal["surgpose", "surgsync"]


@dataclass(frozen=True)
class BenchDataSet(RangedOptions):
    """Evaluate the recordings of a published data set, and write a table of delays, corrections and keypoint errors."""

    data_set: Annotated[DataSet, tyro.conf.Positional]
    """Data set."""
    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a recording, or of several."""
    output: Path | None = None
    """Folder of the table; by default `runs/bench/surgpose` or `runs/bench/surgsync`."""
    frames: Count = 50
    """Number of evenly spaced frames per recording that are corrected and scored."""
    frame_rate: float | None = None
    """Frame rate of images without times [1/s], such as those of raw clips; otherwise, their delay is unknown."""
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)

    def run(self) -> None:
        """Evaluate all recordings; the table is written after each."""
        import json
        from dataclasses import asdict

        from ..files import write_text
        from ..lab.benchmark.data_sets import bench_recording, recordings, table

        paths = recordings(self.folder, self.data_set)
        output, networks = output_folder(self.output, "bench", self.data_set), self.network.load()
        results = []
        with Bar() as bar, message_if_stopped(f"{output} holds the table of the finished recordings"):
            task = bar.add_task(self.data_set, total=len(paths))
            for number, path in enumerate(paths):

                def say(step: str, name: str = path.name) -> None:
                    bar.update(task, description=f"{name}: {step}")

                own = output.path / f"{number:03d}_{path.name}"
                results += bench_recording(path, self.data_set, own, networks, self.frames, self.frame_rate, say)
                write_text(output / "results.json", json.dumps([asdict(result) for result in results], indent=1))
                write_text(output / "table.md", "\n".join(table(results)) + "\n")
                bar.update(task, advance=1)
        for line in table(results):
            bar.console.print(line, soft_wrap=True, markup=False)
        bar.console.print(f"wrote {output}: table.md and results.json")


@dataclass(frozen=True)
class Bench:
    """Measure accuracy and speed of all methods, and write a report; rerun the command to resume.

    `carts bench surgpose FOLDER` and `carts bench surgsync FOLDER` evaluate recordings of these data sets.
    """

    output: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of the report; by default `runs/bench/quick` or `runs/bench/full`."""
    quick: bool = False
    """Use few frames and steps: minutes instead of hours."""
    real: Path | None = None
    """Sequence file with real frames and masks, evaluated with the recorded background and with other backgrounds."""
    rooms: Path | None = None
    """Folder of photographs used as additional backgrounds."""
    report_only: bool = False
    """Only write the report, from earlier measurements."""
    frames: int | None = None
    """Number of frames per sequence; by default that of the quick or full benchmark."""
    seed: int | None = None
    """Seed of the synthetic sequence."""
    baselines: tuple[Path, ...] = ()
    """Weights files from `carts baseline`; each adds a row to the main table."""
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)

    def run(self) -> None:
        """Run the missing measurements and write the report."""
        from importlib.metadata import version

        from ..lab.benchmark import FULL, QUICK, TEST_SEED, Benchmark, Facts, ResultsFile, plan, write_report
        from ..lab.benchmark.hand_eye import known_hand_eye, measure_hand_eye
        from ..lab.benchmark.measurement import code_fingerprint, known_stages, measure_stages
        from ..lab.benchmark.sources import (
            family_sources,
            real_source,
            room_sources,
            synthetic_room_source,
            synthetic_source,
        )

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
            console.print(
                f"{results.path}: {counted(results.unreadable, 'unreadable line')} ignored; measurements are repeated"
            )
        stages, hand_eye = folder / "stages.json", folder / "hand_eye.json"
        if not self.report_only:
            with message_if_stopped(f"{results.path} holds the finished measurements; rerun the command to resume"):
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
        """Row name -> baseline network."""
        from ..lab.baselines.networks import read_baseline

        found: dict[str, TrainedBaseline] = {}
        for path in self.baselines:
            trained = read_baseline(path)
            if trained.row in found:
                raise CartsError(
                    f"--baselines gives two files for the row {trained.row}; {path} is the second. Give one file per "
                    "network and augmentation, and the other file in a separate run."
                )
            found[trained.row] = trained
        return found
