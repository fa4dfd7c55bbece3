"""Training of a baseline: frames of ours, the paper's loss, a checkpoint now and then."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ...errors import SettingsError
from ...files import OutputPath, locked_folder, output_path
from ...model.surface import NORMALS
from ...networks.network import channels_last
from ...settings.baseline import BaselineNetwork, BaselineTraining
from ...stopping import finished_first
from ..training.checkpoint import History, load_checkpoint, save_checkpoint
from ..training.training import schedule
from ..training.validation import dice
from .augmentation import augmentation
from .frames import SIZE, TrainingFrames, chunks_of, make_chunk, missing_chunks
from .networks import Baseline
from .weights import save_baseline, start_from

WEIGHTS_FILE = "baseline.safetensors"
VALIDATION = 100
"""The last so many frames are not learned from."""
_MAY_CHANGE = ("steps", "minutes", "checkpoint_every", "threads", "device")
_LOG_EVERY = 20


@dataclass(frozen=True)
class BaselineResult:
    """What a finished run leaves behind."""

    weights: Path
    steps: int
    dice: float
    """Of the validation frames, which no augmentation changed."""
    processor_seconds: float
    """Time of the training process over all resumed parts [s]."""


def prepare_frames(
    folder: OutputPath, training: BaselineTraining, say: Callable[[str], None] = lambda line: None
) -> TrainingFrames:
    """The training frames in a folder, which all baselines may share; those that are not there are made.

    Raises:
        OutputError: the folder cannot be written to.
        WeightsError: it holds other frames.
    """
    with locked_folder(folder.path):
        for chunk in missing_chunks(folder, training.frames):
            say(f"training frames: part {chunk + 1} of {chunks_of(training.frames)}")
            make_chunk(folder, chunk, training.seed)
    return TrainingFrames(folder, range(chunks_of(training.frames)))


def train_baseline(
    network: BaselineNetwork,
    training: BaselineTraining,
    frames: TrainingFrames,
    output: Path,
    say: Callable[[str], None] = lambda line: None,
) -> BaselineResult:
    """Train a baseline, or go on with the run that `output` holds.

    Args:
        network: which, and how large.
        training: how.
        frames: what is learned from.
        output: folder of `checkpoint.safetensors` and, at the end, `baseline.safetensors`.
        say: is called with a line now and then.

    Raises:
        CartsError: the extra is not installed.
        SettingsError: the network does not fit the frames, or `output` holds a run with other settings.
        WeightsError: a file to start from cannot be read.
        OutputError: `output` cannot be written to, or another process trains there.
    """
    if network.size != SIZE:
        raise SettingsError(f"size is {network.size}, but training frames have {SIZE} px. Leave it as it is.")
    torch.set_num_threads(training.threads)
    with locked_folder(output):
        run = _Run(network, training, frames, output)
        try:
            return run.finish(say)
        except KeyboardInterrupt:
            run.save()
            raise


class _Run:
    """The state of one training run."""

    def __init__(
        self, network: BaselineNetwork, training: BaselineTraining, frames: TrainingFrames, output: Path
    ) -> None:
        self.training, self.frames, self.output = training, frames, output
        torch.manual_seed(training.seed)
        self.network = Baseline(network)
        if training.start is not None:
            start_from(self.network, training.start)
        channels_last(self.network.to(training.device))
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), training.learning_rate, weight_decay=training.weight_decay
        )
        start = training.start.name if training.start else None
        self.config = json.dumps({"network": asdict(network), **asdict(training), "start": start})
        self.step, self.history = 0, History()
        checkpoint = load_checkpoint(output)
        if checkpoint is not None:
            before, now = json.loads(checkpoint.config_json), json.loads(self.config)
            changed = [name for name in now if name not in _MAY_CHANGE and before.get(name) != now[name]]
            if changed:
                raise SettingsError(
                    f"{output} holds a run with other settings ({', '.join(changed)}). Give the same settings to go "
                    "on with it, or another output folder to start anew."
                )
            checkpoint.restore({"network": self.network}, self.optimizer)
            self.step, self.history = checkpoint.step, checkpoint.history
        self._before, self._began, self._processor = self.history.seconds, time.perf_counter(), time.process_time()

    def finish(self, say: Callable[[str], None]) -> BaselineResult:
        """Do the steps that are left, validate, and write the weights."""
        losses: list[float] = []
        while self.step < self._planned():
            with finished_first():
                losses.append(self._train_step())
            if self.step % _LOG_EVERY == 0:
                self.history.losses.append({"step": self.step, "loss": float(np.mean(losses))})
                say(f"step {self.step} of {self._planned()}: loss {np.mean(losses):.4f}")
                losses = []
            if self.step % self.training.checkpoint_every == 0:
                self.save()
        self.save()
        score = self.validate()
        path = output_path(self.output, WEIGHTS_FILE)
        seconds = sum(entry.get("processor_seconds", 0.0) for entry in self.history.validations)
        figures: dict[str, Any] = {"steps": self.step, "dice": score, "processor_seconds": round(seconds, 1)}
        save_baseline(self.network, path, {**json.loads(self.config), **figures})
        return BaselineResult(path.path, self.step, score, seconds)

    @torch.no_grad()
    def validate(self) -> float:
        """Mean Dice over the frames that are not learned from."""
        self.network.eval()
        found = []
        count = len(self.frames)
        for first in range(count - VALIDATION, count, 10):
            images, given, masks = self.frames.batch(range(first, min(first + 10, count)))
            logits = self._logits(images.float() / 255, given)
            found.append(dice(logits[:, 0].cpu() > 0, masks[:, 0] > 0.5))
        return float(torch.cat(found).mean())

    def save(self) -> None:
        """Keep what was trained so far."""
        now, processor = time.perf_counter(), time.process_time()
        self.history.seconds = self._before + now - self._began
        self.history.validations.append({"step": self.step, "processor_seconds": processor - self._processor})
        self._processor = processor
        modules: dict[str, torch.nn.Module] = {"network": self.network}
        save_checkpoint(self.output, modules, self.optimizer, self.step, self.config, self.history)

    def _planned(self) -> int:
        """Steps of the whole run: as many as asked for, or fewer if its time allows no more at the pace so far."""
        if self.training.minutes is None or self.step == 0:
            return self.training.steps
        seconds = self._before + time.perf_counter() - self._began
        return min(self.training.steps, max(self.step, int(self.step * 60 * self.training.minutes / seconds)))

    def _train_step(self) -> float:
        training = self.training
        for group in self.optimizer.param_groups:
            group["lr"] = training.learning_rate * schedule(self.step, training.warmup, self._planned())
        self.network.train()
        images, given, masks = self._batch()
        loss = functional.binary_cross_entropy_with_logits(self._logits(images, given), masks)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self.optimizer.step()
        self.step += 1
        return float(loss.detach())

    def _batch(self) -> tuple[Tensor, Tensor, Tensor]:
        """The batch of the next step: it depends on the seed and the step's number only."""
        rng = np.random.default_rng((self.training.seed, self.step))
        torch.manual_seed(int(rng.integers(2**63)))
        numbers = rng.integers(len(self.frames) - VALIDATION, size=self.training.batch_size)
        images, given, masks = self.frames.batch(map(int, numbers))
        change = augmentation(self.training.augmentation, rng)
        changed = [change(image, mask) for image, mask in zip(images, masks, strict=True)]
        images, masks = (torch.stack(part) for part in zip(*changed, strict=True))
        for dimension, normal in ((-1, NORMALS.start), (-2, NORMALS.start + 1)):
            if rng.integers(2):
                images, given, masks = (part.flip(dimension) for part in (images, given, masks))
                given[:, normal] *= -1
        device = self.training.device
        return images.to(device).float() / 255, given.to(device), masks.to(device)

    def _logits(self, images: Tensor, given: Tensor) -> Tensor:
        device, bfloat16 = self.training.device, self.training.bfloat16
        images = images.to(device).contiguous(memory_format=torch.channels_last)
        enabled = device != "cpu" if bfloat16 is None else bfloat16
        with torch.autocast(device.split(":")[0], torch.bfloat16, enabled=enabled):
            return self.network(images, given.to(device)).float()
