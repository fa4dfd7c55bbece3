"""`carts synthesize`: make a sequence with known truth."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..console import Bar
from ..settings import SynthesisConfig
from ..stopping import when_stopped


@dataclass(frozen=True)
class Synthesize:
    """Make a sequence of two instruments, or of one arm of any other robot, over tissue, path-traced, with true and
    measured kinematics, in all domains."""

    output: Annotated[Path, tyro.conf.Positional]
    """Folder to make; it must not exist."""
    synthesis: Annotated[SynthesisConfig, tyro.conf.arg(name="")] = field(default_factory=SynthesisConfig)

    def run(self) -> None:
        """Write the sequence."""
        from ..lab.synthesis.synthesize import synthesize

        with Bar() as bar:
            task = bar.add_task("synthesizing", total=None)
            with when_stopped("frames that were made are kept beside the output; the same command goes on from there"):
                path = synthesize(
                    self.synthesis,
                    self.output,
                    lambda what, done, total: bar.update(task, description=what, completed=done, total=total),
                )
        bar.console.print(f"wrote {path}")
