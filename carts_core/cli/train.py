"""`carts train`: train the feature network on synthetic images."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import TimeRemainingColumn

from ..console import Bar, Terminal
from ..settings import TrainingConfig
from .selection import check_device


@dataclass(frozen=True)
class Train:
    """Train a network on synthetic images; run it again to go on after an interruption."""

    output: Annotated[Path, tyro.conf.Positional] = Path("runs/train")
    """Folder for checkpoints, weights and the training report."""
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)

    def run(self) -> None:
        """Train to the end."""
        from ..lab.training.training import TrainingProgress, train

        check_device(self.training.device)
        console = Terminal()
        with Bar(*Bar.get_default_columns()[:-1], TimeRemainingColumn(), console=console) as bar:
            task = bar.add_task("training", total=self.training.steps)

            def report(progress: TrainingProgress) -> None:
                text = f"loss {progress.loss:.3f}, {progress.seconds_per_step:.2f} s a step"
                bar.update(task, completed=progress.step, total=progress.steps, description=text)

            result = train(self.training, self.output, report)
        console.print(f"weights: {result.weights}\nreport:  {result.report}\n{result.validation}")
