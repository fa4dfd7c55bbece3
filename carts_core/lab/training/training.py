"""Training of the networks: `train` runs or resumes a training and writes a report."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from ...errors import SettingsError
from ...files import OutputPath, locked_folder, output_path, output_stream, write_text
from ...html import render_page
from ...networks.network import ImageNetwork, channels_last
from ...networks.surface import SurfaceNetwork
from ...networks.weights import read_weights, save_weights
from ...settings import TrainingConfig
from ...stopping import finished_first, message_if_stopped
from ...wording import counted
from .cache import make_cache
from .digests import run_digests
from .loader import training_batches, validation_set
from .loop import History, TrainingLoop
from .tasks import Batch, task_of


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a run, reported once per logged step."""

    step: int
    """Number of completed steps."""
    steps: int
    """Total number of steps; an estimate if the run has a time limit."""
    loss: float
    """Mean loss of the last steps."""
    seconds_per_step: float
    """Wall time per step [s]."""
    validation: dict[str, float] | None
    """Metrics of the latest validation."""
    first: dict[str, float] | None
    """Metrics of the run's first validation, including resumed parts."""


@dataclass(frozen=True)
class TrainingResult:
    """Files and metrics of a finished run."""

    weights: Path
    """Weights file, ready for `FeatureExtractor.load`."""
    report: Path
    """Page of the training report."""
    validation: dict[str, float]
    """Metrics of the saved weights."""
    first: dict[str, float] | None
    """Metrics of the run's first validation; None without validation."""
    seconds: float
    """Wall time spent in training steps, over all resumed parts [s]."""


matplotlib.use("Agg")

Panels = list[list[tuple[str, np.ndarray]]]
"""Images with titles, by sample; images without colour channels have values from -1 to 1."""


def write_report(folder: OutputPath, config: dict, history: History, columns: dict[str, str], examples: Panels) -> Path:
    """Write `curves.png`, `predictions.jpg` and `README.md`; returns the path of `README.md`."""
    with output_stream(folder / "curves.png") as stream:
        _curves(history, columns).savefig(stream, format="png", dpi=110)
    with output_stream(folder / "predictions.jpg") as stream:
        _predictions(examples).savefig(stream, format="jpg", dpi=110, pil_kwargs={"quality": 85})
    page = render_page(
        "training.md",
        config=config,
        columns=columns,
        validations=history.validations,
        steps=counted(int(history.losses[-1]["step"]) if history.losses else 0, "step"),
        samples=counted(config["batch_size"], "sample"),
        minutes=counted(round(history.seconds / 60), "minute"),
        settings=json.dumps(config, indent=2).replace("`", "\\u0060"),
        nan=math.nan,
    )
    write_text(folder / "README.md", page)
    return (folder / "README.md").path


def _curves(history: History, columns: dict[str, str]) -> Figure:
    figure = Figure(figsize=(3.3 * (1 + len(columns)), 3.4), layout="constrained")
    loss_axes, *others = figure.subplots(1, 1 + len(columns))
    steps = [entry["step"] for entry in history.losses]
    for name in history.losses[0] if history.losses else ():
        if name not in ("step", "loss"):
            values = [entry[name] for entry in history.losses]
            loss_axes.plot(steps, values, label=name.replace("_", " "), linewidth=0.9)
    loss_axes.set(title="training loss, per term", xlabel="step", yscale="log")
    if loss_axes.lines:
        loss_axes.legend(fontsize=8)
    steps = [entry["step"] for entry in history.validations]
    for axes, (name, title) in zip(others, columns.items(), strict=True):
        axes.plot(steps, [entry.get(name, math.nan) for entry in history.validations], ".-")
        axes.set(title=f"validation: {title}", xlabel="step")
    for axes in (loss_axes, *others):
        axes.grid(alpha=0.3)
        axes.title.set_fontsize(9)
    return figure


def _predictions(examples: Panels) -> Figure:
    titles = [title for title, _ in examples[0]]
    figure = Figure(figsize=(2.2 * len(titles), 1.75 * len(examples)), layout="constrained")
    rows = figure.subplots(len(examples), len(titles), squeeze=False)
    for row, panels in zip(rows, examples, strict=True):
        for axes, (_, panel) in zip(row, panels, strict=True):
            flat = panel.ndim == 2
            axes.imshow(panel, vmin=-1 if flat else None, vmax=1 if flat else None, cmap="RdYlGn")
            axes.set_axis_off()
    for axes, title in zip(rows[0], titles, strict=True):
        axes.set_title(title, fontsize=9)
    return figure


_LOG_EVERY = 10
_ENCODER_DEFAULTS = TrainingConfig.frozen, TrainingConfig.encoder_rate
_EXAMPLES = 6
_MAY_CHANGE = (
    "steps",
    "minutes",
    "workers",
    "threads",
    "device",
    "validation_every",
    "checkpoint_every",
    "patience",
    "cached",
)


def train(
    config: TrainingConfig, output: Path, progress: Callable[[TrainingProgress], None] | None = None
) -> TrainingResult:
    """Train a network, or resume the run in `output`.

    The run writes `checkpoint.safetensors` periodically, the weights after every validation (with `patience`, only
    after an improvement), and `report/` at the end. If the process is killed, the same call resumes from the last
    checkpoint.

    Raises:
        SettingsError: `output` holds a run with other settings.
        WeightsError: the checkpoint or the initial weights cannot be read.
        RobotError: a robot cannot be loaded.
        OutputError: `output` cannot be written to, or another process trains there.
    """
    torch.set_num_threads(config.threads)
    with locked_folder(output):
        run = _Run(config, output)
        try:
            with message_if_stopped(run.kept):
                return run.finish(progress or (lambda event: None))
        except KeyboardInterrupt:
            run.loop.save()
            raise


class _Run:
    """Training run: training loop, exponential moving average of the weights, and validations of the average."""

    def __init__(self, config: TrainingConfig, output: Path) -> None:
        torch.manual_seed(config.seed)
        self.network = channels_last(_first_network(config).to(config.device))
        if isinstance(self.network, SurfaceNetwork):
            self.network.encoder.freeze(config.frozen)
        elif (config.frozen, config.encoder_rate) != _ENCODER_DEFAULTS:
            raise SettingsError(
                f"frozen is {config.frozen} and encoder_rate {config.encoder_rate}, but "
                f"{config.start or 'the feature network'} has no pretrained encoder. Leave out these settings."
            )
        config = _with_architecture(config, self.network)
        self.config, self.output, self.task = config, output, task_of(config.network)
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(config.average), use_buffers=True)
        self.settings = recorded_settings(config)
        self.loop = TrainingLoop(
            output, self.network, config, json.dumps(self.settings), _MAY_CHANGE, {"average": self.average}
        )
        self.history = self.loop.history

    def finish(self, progress: Callable[[TrainingProgress], None]) -> TrainingResult:
        """Run the remaining steps, validate, and write weights and report."""
        samples = validation_set(self.config)
        validation, loop = None, self.loop
        if self.config.patience is not None and not self.history.validations:
            # The initial validation is the baseline for `patience`.
            validation = self._validate(samples)
            progress(TrainingProgress(loop.step, loop.planned, math.nan, math.nan, validation, validation))
        elif self._lacks_validation():
            validation = self._validate(samples)
            loop.checkpoint()
        if loop.step < loop.planned and not self._has_ended_gaining():
            validation = self._train(samples, validation, progress)
        if self.config.patience is not None:
            validation = max(self.history.validations, key=self._score)
        elif validation is None:
            validation = self.task.validate(self._averaged().folded(), samples)
            self._save(validation)
        examples = self.task.panels(self._averaged().folded(), tuple(part[:_EXAMPLES] for part in samples))
        folder = output_path(self.output, "report")
        report = write_report(folder, self.settings, self.history, self.task.columns, examples)
        weights = weights_file(self.config, self.output)
        return TrainingResult(weights, report, validation, self.history.first, self.history.seconds)

    def _train(
        self, samples: Batch, validation: dict[str, float] | None, progress: Callable[[TrainingProgress], None]
    ) -> dict[str, float] | None:
        """Train to the end; returns the latest validation, or `validation` without a new one."""

        def loss(batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
            return self.task.loss(self.config, self.network, tuple(part.to(self.config.device) for part in batch))

        def ends(last: bool) -> bool:
            nonlocal validation
            if last or self.loop.step % self.config.validation_every == 0:
                validation = self._validate(samples)
                last = last or self._has_ended_gaining()
            return last

        def logged(means: dict[str, float], seconds_per_step: float) -> None:
            reached = means["loss"], seconds_per_step, validation, self.history.first
            progress(TrainingProgress(self.loop.step, self.loop.planned, *reached))

        if self.config.cache is not None:
            make_cache(self.config.cache, self.config)
        with training_batches(self.config, self.loop.step) as batches:
            self.loop.run(
                batches,
                loss,
                _LOG_EVERY,
                logged,
                updated=lambda: self.average.update_parameters(self.network),
                ends=ends,
            )
        return validation

    def _lacks_validation(self) -> bool:
        """Whether the run was stopped between a step and its validation."""
        loop, known = self.loop, self.history.validations
        due = loop.step >= loop.planned or (loop.step > 0 and loop.step % self.config.validation_every == 0)
        return due and not (known and known[-1]["step"] == loop.step)

    def kept(self) -> str:
        """Message on the files of a stopped run."""
        if self.loop.step == 0:
            return f"no step was taken; any weights in {self.output} are the initial weights"
        return f"{self.output} holds {counted(self.loop.step, 'step')}; rerun the command to resume"

    def _averaged(self) -> ImageNetwork:
        network = self.average.module
        assert isinstance(network, ImageNetwork)
        return network

    def _score(self, entry: dict[str, float]) -> float:
        """Score of a validation (higher values are better); minus infinity if a metric is worse than at the start."""
        worse = self.history.first is not None and self.task.worse(entry, self.history.first)
        return -math.inf if worse else entry[self.task.score]

    def _validate(self, samples: Batch) -> dict[str, float]:
        validation = self.task.validate(self._averaged().folded(), samples)
        best = max(map(self._score, self.history.validations), default=-math.inf)
        with finished_first():
            self.history.validations.append({"step": self.loop.step, **validation})
            if self.config.patience is None or self._score(validation) > best:
                self._save(validation)
        return validation

    def _has_ended_gaining(self) -> bool:
        """Whether none of the latest `patience` validations is better than the best earlier validation."""
        patience = self.config.patience
        scores = [self._score(entry) for entry in self.history.validations]
        if patience is None or len(scores) <= patience:
            return False
        return max(scores[-patience:]) <= max(scores[:-patience])

    def _save(self, validation: dict[str, float]) -> None:
        training = {"step": self.loop.step, "validation": validation, "config": self.settings}
        # The aspect ratio of the camera image is 4:3, as for an endoscope; training images are crops.
        field, stride = self.config.images.field_width, self._averaged().architecture.stride
        size = tuple(stride * max(round(side / stride), 1) for side in (field, 0.75 * field))
        save_weights(self._averaged(), weights_file(self.config, self.output), training, size)


def _first_network(config: TrainingConfig) -> ImageNetwork:
    if config.start is None:
        return task_of(config.network).network(config)
    network = read_weights(config.start).network
    if network.kind != config.network:
        raise SettingsError(
            f"{config.start} holds a {network.kind} network, but a {config.network} network is to be trained. Give "
            "weights of this kind, or start from random weights."
        )
    return network


def _with_architecture(config: TrainingConfig, network: ImageNetwork) -> TrainingConfig:
    """Settings with the architecture of the initial weights."""
    if isinstance(network, SurfaceNetwork):
        return replace(config, surface_architecture=network.architecture)
    return replace(config, architecture=network.architecture)


def weights_file(config: TrainingConfig, output: Path) -> Path:
    """Path of a run's weights file."""
    return output / f"{config.network}.safetensors"


def recorded_settings(config: TrainingConfig) -> dict[str, Any]:
    """Settings as JSON values, with names and digests of files, so that the files of a run can be moved."""
    settings = asdict(config)
    settings["start"] = config.start.name if config.start else None
    settings["robots"] = [path.name for path in config.robots]
    settings["cache"] = config.cache.name if config.cache else None
    folder = config.images.photographs
    settings["images"]["photographs"] = folder.name if folder else None
    recording = config.images.recording
    settings["images"]["recording"] = recording.name if recording else None
    return json.loads(json.dumps(settings | run_digests(config)))
