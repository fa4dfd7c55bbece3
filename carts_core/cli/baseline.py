"""`carts baseline`: train a network of others on our synthetic frames, as a row of the benchmark."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..console import Terminal
from ..files import output_path
from ..settings.baseline import BaselineNetwork, BaselineTraining
from ..stopping import when_stopped
from .selection import check_device


@dataclass(frozen=True)
class Baseline:
    """Train HRNet, Swin, Colleoni's network or a U-Net for `carts bench --baselines`; run it again to go on."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder for checkpoint and weights."""
    frames: Path = Path("runs/baseline_frames")
    """Folder of training frames, made where they are missing, and shared by all baselines."""
    network: Annotated[BaselineNetwork, tyro.conf.arg(name="")] = field(default_factory=BaselineNetwork)
    training: BaselineTraining = field(default_factory=BaselineTraining)
    """How it is trained."""

    def run(self) -> None:
        """Train to the end."""
        from ..lab.baselines.training import prepare_frames, train_baseline

        check_device(self.training.device)
        console = Terminal()

        def say(line: str) -> None:
            console.print(line, soft_wrap=True)

        with when_stopped(f"{self.output} holds what was trained; the same command goes on from there"):
            frames = prepare_frames(output_path(self.frames), self.training, say)
            result = train_baseline(self.network, self.training, frames, self.output, say)
        say(f"weights: {result.weights}\n{result.steps} steps, Dice {result.dice:.3f} on frames not learned from")
