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
    for_: Annotated[Path | None, tyro.conf.arg(name="for", metavar="SEQUENCE")] = None
    """Sequence file to adapt the shipped network to: its robots, cameras, distances and empty backgrounds. It ends when
    it no longer gains, or after --minutes, 15 by default."""
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)

    def run(self) -> None:
        """Train to the end."""
        from ..lab.training.progress import TrainingProgress
        from ..lab.training.training import train

        check_device(self.training.device)
        console = Terminal()
        if self.for_ is not None:
            self._adapt(self.for_, console)
            return
        with Bar(*Bar.get_default_columns()[:-1], TimeRemainingColumn(), console=console) as bar:
            task = bar.add_task("training", total=self.training.steps)

            def report(progress: TrainingProgress) -> None:
                text = f"loss {progress.loss:.3f}, {progress.seconds_per_step:.2f} s a step"
                bar.update(task, completed=progress.step, total=progress.steps, description=text)

            result = train(self.training, self.output, report)
        console.print(f"weights: {result.weights}\nreport:  {result.report}\n{result.validation}")

    def _adapt(self, recording: Path, console: Terminal) -> None:
        """Adapt the shipped network to a recording, saying each minute what is reached."""
        from ..lab.training.adaptation import adapted_to, gain
        from ..lab.training.progress import TrainingProgress
        from ..lab.training.training import train

        config = adapted_to(recording, self.output, self.training)
        said: dict[str, float] | None = None

        def report(progress: TrainingProgress) -> None:
            nonlocal said
            if progress.validation is None or progress.first is None or progress.validation is said:
                return
            said = progress.validation
            console.print(f"step {progress.step}: {gain(progress.first, said)}", soft_wrap=True)

        result = train(config, self.output, report)
        console.print(f"weights: {result.weights}\nreport:  {result.report}")
        if result.first is not None:
            console.print(f"kept, the best: {gain(result.first, result.validation)}", soft_wrap=True)
        console.print(f"Use: carts optimize {recording} --weights {result.weights}", soft_wrap=True)
