"""Checkpoints: the whole state of a training run in one safetensors file, replaced in one go."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ...errors import WeightsError
from ...files import output_path, write_bytes
from ...files.reading import WEIGHTS, check_regular, parse_json
from ...networks.weights import tensor_bytes

CHECKPOINT_FILE = "checkpoint.safetensors"


@dataclass
class History:
    """What a run has shown so far."""

    losses: list[dict[str, float]] = field(default_factory=list)
    """Per logged step: `step`, `loss` and each term, averaged since the last entry."""
    validations: list[dict[str, float]] = field(default_factory=list)
    """Per validation: `step` and the figures of `Validation`."""
    seconds: float = 0.0
    """Wall time spent in training steps [s]."""
    processor_seconds: float = 0.0
    """Processor time of each thread of the training process there [s]."""

    @property
    def first(self) -> dict[str, float] | None:
        """The first validation; None before it."""
        return next(iter(self.validations), None)


def save_checkpoint(
    folder: Path,
    modules: dict[str, torch.nn.Module],
    optimizer: torch.optim.Optimizer,
    step: int,
    config_json: str,
    history: History,
) -> None:
    """Write `checkpoint.safetensors`; a kill at any moment leaves the old file or the new one.

    Args:
        folder: folder of the run.
        modules: modules whose state is kept, by name.
        optimizer: its moments and step counts are kept.
        step: number of steps done.
        config_json: the settings; `load_checkpoint` gives them back.
        history: curves so far.
    """
    tensors = {f"{name}/{key}": value for name, module in modules.items() for key, value in module.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer/{index}/{key}": value for key, value in state.items()}
    metadata = {"step": str(step), "config": config_json, "history": json.dumps(asdict(history))}
    content = tensor_bytes({name: value.detach().clone().contiguous() for name, value in tensors.items()}, metadata)
    write_bytes(output_path(folder, CHECKPOINT_FILE), content)


@dataclass(frozen=True)
class Checkpoint:
    """What `load_checkpoint` found."""

    step: int
    config_json: str
    history: History
    tensors: dict[str, Tensor]

    def restore(self, modules: dict[str, torch.nn.Module], optimizer: torch.optim.Optimizer) -> None:
        """Put the state back into modules and optimizer."""
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
    """The checkpoint of a run, None if there is none yet.

    Raises:
        WeightsError: the file is there and cannot be read.
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
            f"checkpoint {path} cannot be read ({error}). Allowed is what `carts train` writes. Delete the file to "
            "start this run again."
        ) from error
