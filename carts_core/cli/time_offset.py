"""`carts time-offset`: the delay between images and kinematics, from the motion that both show."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..console import Bar, Terminal
from .selection import SequencePath


@dataclass(frozen=True)
class TimeOffset:
    """Estimate the delay between images and joint positions from how both move, and propose a time_offset.

    Neither a hand-eye calibration nor a network is needed. The sequence file stays as it is.
    """

    sequence: SequencePath
    """Sequence file whose rows are matched with frames by time ([frames])."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to make for a sequence file with the proposed time_offset; by default it is only said."""
    overwrite: bool = False
    """Replace an earlier one there."""
    camera: str | None = None
    """Whose images count; by default the first camera's."""
    domain: str | None = None
    """Of the images; by default the first one."""
    largest: float = 0.5
    """How far from the present time_offset it is looked for first [s]; up to 3 s where that explains little."""

    def run(self) -> None:
        """Say what the motion says, and write a file where that was asked for."""
        from ..files import MARKER, published, write_text
        from ..recording import Sequence, calibrated_sequence_file, estimate_time_offset

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        with Bar(console=console) as bar:
            task = bar.add_task("motion in the images", total=None)
            found = estimate_time_offset(
                sequence,
                self.camera,
                domain=self.domain,
                largest=self.largest,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
        console.print(found.sentence())
        if found.proposed is None:
            return
        if self.output is None:
            console.print(f"Write it under [frames] in {self.sequence}, or name a folder with -o.")
            return
        with published(self.output, overwrite=self.overwrite) as folder:
            text = calibrated_sequence_file(
                sequence.path, self.output, sequence.scene, sequence.scene, "time-offset", found.proposed
            )
            write_text(folder / "sequence.toml", text)
            write_text(folder / MARKER, json.dumps({"format": "time-offset", "sequence": str(self.sequence)}, indent=1))
        console.print(f"wrote {self.output}/sequence.toml")
