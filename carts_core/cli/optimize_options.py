"""What a command line of `carts optimize` says."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..errors import SettingsError
from .observing import Observing
from .selection import Mode, Perturbation, Selection, SequencePath
from .solver_options import FreeInFrames, SolverOptions


@dataclass(frozen=True)
class OptimizeOptions:
    """The sequence, the chosen frames, and how they are corrected."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/DOMAIN/CAMERA`, with the names of all cameras under --together."""
    overwrite: bool = False
    """Start over: everything that the folder holds is made again."""
    mode: Mode = "frame"
    """Correct each frame alone, or all together, so that frames inform each other (docs: sequences)."""
    together: bool = False
    """Optimize a frame with all chosen cameras at once (stereo); otherwise once per camera."""
    keyframes: Path | None = None
    """`sequence` mode: kinematics table of frames that a person set (its rows with the source `edited`)."""
    start: Annotated[Perturbation, tyro.conf.arg(name="")] = field(default_factory=Perturbation)
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)
    free: Annotated[FreeInFrames, tyro.conf.arg(name="")] = field(default_factory=FreeInFrames)
    network: Annotated[Observing, tyro.conf.arg(name="")] = field(default_factory=Observing)
    solving: Annotated[SolverOptions, tyro.conf.arg(name="")] = field(default_factory=SolverOptions)

    def __post_init__(self) -> None:
        if self.keyframes is not None and self.mode != "sequence":
            raise SettingsError(f"--keyframes {self.keyframes} needs --mode sequence. Add it, or leave both out.")
        if self.mode == "sequence":
            self.solving.check_surface("--mode sequence")
