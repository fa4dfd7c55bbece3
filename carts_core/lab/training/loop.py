"""Training loop: optimizer steps with a learning-rate schedule, a time limit, a history, and checkpoints.

A checkpoint is a safetensors file with the complete state of a run, replaced atomically.
"""

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from ...errors import SettingsError, WeightsError
from ...files import output_path, write_bytes
from ...files.reading import WEIGHTS, check_regular, parse_json
from ...networks.surface import SurfaceNetwork
from ...networks.weights import tensor_bytes
from ...settings import TrainingConfig
from ...settings.training import BaselineTraining
from ...stopping import finished_first

CHECKPOINT_FILE = "checkpoint.safetensors"


@dataclass
class History:
    """Losses, validations and times of a run."""

    losses: list[dict[str, float]] = field(default_factory=list)
    """One entry per logged step: `step`, and means of `loss` and its terms since the previous entry."""
    validations: list[dict[str, float]] = field(default_factory=list)
    """One entry per validation: `step` and the metrics of the task."""
    seconds: float = 0.0
    """Wall time spent in training steps [s]."""
    processor_seconds: float = 0.0
    """CPU time of the training process in these steps, divided by its number of threads [s]."""

    @property
    def first(self) -> dict[str, float] | None:
        """First validation; None without validations."""
        return next(iter(self.validations), None)


def save_checkpoint(
    folder: Path,
    modules: dict[str, torch.nn.Module],
    optimizer: torch.optim.Optimizer,
    step: int,
    config_json: str,
    history: History,
) -> None:
    """Atomically write `checkpoint.safetensors` with the state of modules by name, optimizer and run."""
    tensors = {f"{name}/{key}": value for name, module in modules.items() for key, value in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer/{index}/{key}": value for key, value in state.items()}
    metadata = {"step": str(step), "config": config_json, "history": json.dumps(asdict(history))}
    content = tensor_bytes({name: value.detach().clone().contiguous() for name, value in tensors.items()}, metadata)
    write_bytes(output_path(folder, CHECKPOINT_FILE), content)


@dataclass(frozen=True)
class Checkpoint:
    """State of a run, read from its checkpoint."""

    step: int
    config_json: str
    history: History
    tensors: dict[str, Tensor]
    """Tensors of the modules, by module name, and of the optimizer."""

    def restore(self, modules: dict[str, torch.nn.Module], optimizer: torch.optim.Optimizer) -> None:
        """Load the state into modules and optimizer."""
        for name, module in modules.items():
            prefix = f"{name}/"
            module.load_state_dict(
                {key.removeprefix(prefix): value for key, value in self.tensors.items() if key.startswith(prefix)}
            )
        state: dict[int, dict[str, Tensor]] = {}
        for key, value in self.tensors.items():
            if key.startswith("optimizer/"):
                _, index, name = key.split("/")
                state.setdefault(int(index), {})[name] = value
        optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """Read the checkpoint of a run; None without a checkpoint.

    Raises:
        WeightsError: the file exists but cannot be read.
    """
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return None
    try:
        check_regular(path, WEIGHTS)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        history = History(**parse_json(metadata["history"], finite=False))
        return Checkpoint(int(metadata["step"]), metadata["config"], history, tensors)
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise WeightsError(
            f"checkpoint {path} is not a readable checkpoint of `carts train` ({error}). Delete the file to "
            "start this run again."
        ) from error


def checked_checkpoint(folder: Path, settings: dict[str, Any], may_change: tuple[str, ...] = ()) -> Checkpoint | None:
    """Read the checkpoint of a run with these settings; None without a checkpoint.

    Settings that the checkpoint of an older version does not contain are not compared.

    Raises:
        SettingsError: the folder holds a run with other settings.
        WeightsError: the checkpoint cannot be read.
    """
    checkpoint = load_checkpoint(folder)
    if checkpoint is None:
        return None
    before = json.loads(checkpoint.config_json)
    changed = [name for name, value in settings.items() if name not in may_change and before.get(name, value) != value]
    if changed:
        details = ", ".join(f"{name} was {before[name]} and is {settings[name]}" for name in changed)
        raise SettingsError(
            f"{folder} holds a run with other settings: {details}. Give the same settings to resume it, "
            "or choose another output folder."
        )
    return checkpoint


Batch = TypeVar("Batch")


class TrainingLoop:
    """Loop that trains a network with AdamW, or resumes the run whose checkpoint is in `output`.

    Args:
        output: folder for the checkpoint.
        network: the trained network, on its device.
        settings: steps, time limit and learning rate.
        config_json: settings of the run, stored in the checkpoint.
        may_change: names in `config_json` that may differ when the run is resumed.
        further: other modules whose state is stored, by name.

    Raises:
        SettingsError: the folder holds a run with other settings.
        WeightsError: the checkpoint cannot be read.
    """

    def __init__(
        self,
        output: Path,
        network: nn.Module,
        settings: TrainingConfig | BaselineTraining,
        config_json: str,
        may_change: tuple[str, ...],
        further: Mapping[str, nn.Module] | None = None,
    ) -> None:
        self._output, self._network, self._settings, self._config_json = output, network, settings, config_json
        self._modules = {"network": network, **(further or {})}
        self._optimizer = torch.optim.AdamW(
            _groups(network, settings), settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.step = 0
        """Number of completed steps."""
        self.history = History()
        self._resume(may_change)
        self._saved = self.step
        self._clock = time.perf_counter()
        self._worked: float | None = None

    def _resume(self, may_change: tuple[str, ...]) -> None:
        checkpoint = checked_checkpoint(self._output, json.loads(self._config_json), may_change)
        if checkpoint is None:
            return
        checkpoint.restore(self._modules, self._optimizer)
        self.step, self.history = checkpoint.step, checkpoint.history

    def run(
        self,
        batches: Iterator[Batch],
        loss: Callable[[Batch], tuple[Tensor, dict[str, Tensor]]],
        log_every: int,
        logged: Callable[[dict[str, float], float], None],
        *,
        updated: Callable[[], None] = lambda: None,
        ends: Callable[[bool], bool] = lambda last: last,
    ) -> None:
        """Train until the planned steps are done or `ends` returns true; signals are handled at the end of a step.

        Args:
            batches: training batches.
            loss: batch -> weighted loss, and each term before weighting.
            log_every: steps between entries of the history.
            logged: called with the means of loss and terms since the previous entry, and the wall time per step [s].
            updated: called after each optimizer step.
            ends: called after each step, with True at the last planned step; returns whether the run ends.
        """
        sums: dict[str, float] = {}
        count, last = 0, False
        self._clock, self._worked = time.perf_counter(), time.process_time()
        while not last:
            batch = next(batches)
            with finished_first():
                terms = self._train_step(batch, loss)
                updated()
            for name, value in terms.items():
                sums[name] = sums.get(name, 0.0) + value
            count += 1
            last = ends(self.step == self.planned)
            if last or count == log_every:
                means = {name: value / count for name, value in sums.items()}
                self.history.losses.append({"step": self.step, **means})
                logged(means, self._take_time() / count)
                sums, count = {}, 0
            if last or self.step % self._settings.checkpoint_every == 0:
                self.checkpoint()

    def _train_step(
        self, batch: Batch, loss_of: Callable[[Batch], tuple[Tensor, dict[str, Tensor]]]
    ) -> dict[str, float]:
        for group in self._optimizer.param_groups:
            rate = self._settings.learning_rate * schedule(self.step, self._settings.warmup, self.planned)
            group["lr"] = rate * group["factor"]
        self._network.train()
        loss, terms = loss_of(batch)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self._network.parameters(), 5.0)
        self._optimizer.step()
        self.step += 1
        return {"loss": float(loss.detach()), **{name: float(term.detach()) for name, term in terms.items()}}

    @property
    def planned(self) -> int:
        """Total number of steps: the given number, or fewer if the time limit requires it at the current speed."""
        if self._settings.minutes is None or self.step == 0:
            return self._settings.steps
        seconds = self.history.processor_seconds + self._processor_seconds()
        allowed = int(self.step * 60 * self._settings.minutes / max(seconds, 1e-6))
        return min(self._settings.steps, max(self.step, allowed))

    def save(self) -> None:
        """Write a checkpoint unless the last checkpoint is current; used when a run is stopped between two steps."""
        if self.step > self._saved:
            self._take_time()
            self.checkpoint()

    def _processor_seconds(self) -> float:
        """CPU time per thread that is not yet in the history [s]; 0 before `run`."""
        return 0.0 if self._worked is None else (time.process_time() - self._worked) / self._settings.threads

    def _take_time(self) -> float:
        """Add the time since the last call to the history; returns the wall time [s]."""
        elapsed = time.perf_counter() - self._clock
        self.history.seconds += elapsed
        self.history.processor_seconds += self._processor_seconds()
        self._clock, self._worked = time.perf_counter(), time.process_time()
        return elapsed

    def checkpoint(self) -> None:
        """Write a checkpoint."""
        save_checkpoint(self._output, self._modules, self._optimizer, self.step, self._config_json, self.history)
        self._saved = self.step


def _groups(network: nn.Module, settings: TrainingConfig | BaselineTraining) -> list[dict[str, Any]]:
    """Parameter groups with learning-rate factors, which are smaller for a pretrained encoder."""
    if not (isinstance(network, SurfaceNetwork) and isinstance(settings, TrainingConfig)):
        return [{"params": list(network.parameters()), "factor": 1.0}]
    encoder = list(network.encoder.parameters())
    known = set(map(id, encoder))
    others = [parameter for parameter in network.parameters() if id(parameter) not in known]
    return [{"params": others, "factor": 1.0}, {"params": encoder, "factor": settings.encoder_rate}]


def schedule(step: int, warmup: int, steps: int) -> float:
    """Learning-rate factor: linear warm-up, then cosine decay to 0.01."""
    rise = min(1.0, (step + 1) / max(warmup, 1))
    done = min(1.0, max(0.0, (step - warmup) / max(steps - warmup, 1)))
    return rise * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))
