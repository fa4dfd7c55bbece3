"""`carts train`: train the feature network on synthetic images."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import TimeRemainingColumn

from ..console import Bar, Terminal
from ..errors import SettingsError
from ..settings import TrainingConfig
from .selection import check_device


@dataclass(frozen=True)
class Train:
    """Train a network on synthetic images; run it again to go on after an interruption."""

    output: Annotated[Path, tyro.conf.Positional] = Path("runs/train")
    """Folder for checkpoints, weights and the training report."""
    for_: Annotated[Path | None, tyro.conf.arg(name="for", metavar="SEQUENCE")] = None
    """Sequence file to adapt the shipped network to: its robots, cameras, distances and empty backgrounds. It ends when
    it no longer gains, or after 400 --steps or --minutes of processor time. Weights are offered if no fit is worse."""
    fits: int = 8
    """With `--for`: made images on which fits before and after are compared; half as many frames of the recording."""
    training: Annotated[TrainingConfig, tyro.conf.arg(name="")] = field(default_factory=TrainingConfig)

    def __post_init__(self) -> None:
        if self.fits < 1:
            raise SettingsError(f"--fits is {self.fits}; allowed is 1 or more.")

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
        """Adapt the shipped network to a recording, printing each validation; offer the weights if no fit is worse."""
        from ..lab.training.adaptation import adapted_to, gain, offer
        from ..lab.training.progress import TrainingProgress
        from ..lab.training.training import train

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

            bar.update(task, description="making images to measure with")
            result = train(config, self.output, report)

            def compare(text: str, done: int, total: int) -> None:
                bar.update(task, completed=done, total=total, description=text)

            found = offer(config, result, compare, made=self.fits, own=max(1, self.fits // 2))
        console.print(f"report:  {result.report}")
        if result.first is not None:
            console.print(f"kept, the best: {gain(result.first, result.validation)}", soft_wrap=True)
        if result.validation.get("step") == 0:
            console.print("No step gained anything, so the weights are those of the start.")
        for line in found.lines:
            console.print(line, soft_wrap=True)
        if found.weights is None:
            console.print(f"not offered, since worse: {'; '.join(found.worse)}", soft_wrap=True)
            console.print(f"The weights are in {found.refused}. Go on with the network as it was.", soft_wrap=True)
            return
        console.print(f"weights: {found.weights}")
        console.print(f"Use: carts optimize {recording} --weights {found.weights}", soft_wrap=True)
