"""`carts optimize` corrects the kinematics of frames; `carts evaluate` compares results with ground truth."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..console import Terminal, track
from ..errors import SettingsError
from ..stopping import message_if_stopped
from ..wording import counted
from .options import (
    FrameFreeParameters,
    Mode,
    ObservationOptions,
    OptimizeOptions,
    Perturbation,
    ProjectOption,
    Selection,
    SequencePath,
    SolverOptions,
    check_writable,
)


@dataclass(frozen=True)
class Optimize(OptimizeOptions):
    """Correct the kinematics of frames; write masks (PNG) and kinematics (CSV). Rerun the command to resume."""

    def run(self) -> None:
        """Optimize the frames without an up-to-date result."""
        from .optimizing import OptimizeRun

        OptimizeRun(self).run()


STANDARD_OUTPUT = Path("-")
_WIDTH = 110
"""Width of the table in a file or a pipe [characters]."""


@dataclass(frozen=True)
class Evaluate:
    """Optimize frames and compare masks and joints with ground truth, before and after.

    The initial state includes the corrections of the project beside the sequence; without a project, it is the measured
    state.
    """

    sequence: SequencePath
    """Sequence file."""
    json: Path | None = None
    """Write the scores of all frames and their means to this file; missing folders are created. `-` writes the scores
    to the standard output, and all messages to the standard error.
    """
    mode: Mode = "frame"
    """Optimize each frame individually, or all frames jointly (docs: sequences)."""
    together: bool = False
    """Optimize each frame jointly over all selected cameras (stereo); otherwise once per camera."""
    source: Annotated[ProjectOption, tyro.conf.arg(name="")] = field(default_factory=ProjectOption)
    start: Annotated[Perturbation, tyro.conf.arg(name="")] = field(default_factory=Perturbation)
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)
    free: Annotated[FrameFreeParameters, tyro.conf.arg(name="")] = field(default_factory=FrameFreeParameters)
    network: Annotated[ObservationOptions, tyro.conf.arg(name="")] = field(default_factory=ObservationOptions)
    solving: Annotated[SolverOptions, tyro.conf.arg(name="")] = field(default_factory=SolverOptions)

    def __post_init__(self) -> None:
        if self.json == STANDARD_OUTPUT:
            pass
        elif self.json is not None and self.json.is_dir():
            raise SettingsError(f"--json {self.json} is a folder. Give a file.")
        elif self.json is not None:
            check_writable(self.json.parent)
        if self.mode == "sequence":
            self.solving.check_surface("--mode sequence")

    def run(self) -> None:
        """Print a table of means, and write the JSON file if a path is given."""
        from ..evaluation import camera_groups, evaluate, to_json
        from ..files import write_text
        from ..optimization import Backgrounds
        from ..recording import Sequence
        from .printing import base_frame_hint, blank_hint, kept_start_hint, print_hints, score_table, verdict_line

        console = Terminal(stderr=self.json == STANDARD_OUTPUT)
        if not console.is_terminal:
            console.width = _WIDTH  # rich assumes 80 columns, which would truncate the table
        sequence = Sequence.open(self.sequence, progress=console.print)
        frames = self.select.frame_indices(sequence)
        cameras = self.select.camera_names(sequence.scene)
        domains = self.select.domain_names(sequence)
        sequence = self.source.corrected(sequence, frames, console)
        observer = self.network.observer(self.solving.chosen, sequence)
        groups = {group: sequence.with_image(frames, group) for group in camera_groups(cameras, self.together)}
        for group, seen in groups.items():
            observer.check(sequence, seen, group, domains)
        found = evaluate(
            sequence,
            observer.predictor,
            frames=frames,
            cameras=cameras,
            domains=domains,
            settings=self.solving.chosen,
            free=self.solving.freed(self.free),
            model=self.solving.sequence if self.mode == "sequence" else None,
            perturb_deg=self.start.perturb_deg,
            seed=self.start.seed,
            together=self.together,
            given=observer.given,
        )
        print_hints(console, *(blank_hint(", ".join(group), frames, seen) for group, seen in groups.items()))
        total = len(domains) * sum(len(group) * len(seen) for group, seen in groups.items())
        with message_if_stopped("nothing was written"):
            scores = list(track(found, "optimizing", total=total, console=console))
        console.print(score_table(scores, f"{sequence.name}: {counted(len(frames), 'frame')}, means"))
        print_hints(console, self.network.caution)
        for group in groups:
            where, seen = ", ".join(group), [score for score in scores if score.camera == group[0]]
            print_hints(
                console,
                kept_start_hint(where, [score.stopped for score in seen]),
                base_frame_hint(where, [score.base_frame_gain for score in seen]),
                verdict_line(where, [score.verdict for score in seen], [score.not_determined for score in seen]),
            )
        if any(score.verdict not in (None, "good") for score in scores):
            print_hints(console, "--json FILE also writes the reasons for the verdicts.")
        required = self.solving.chosen.needs_background
        for group in [] if observer.masked else groups:
            for domain in domains:
                print_hints(console, *Backgrounds.of(sequence, group, domain, required=required).problems)
        if self.json is not None:
            project = self.source.path(sequence.path)
            made_from = {} if project is None else {"project": str(project)}
            text = json.dumps({**self.network.observed, **made_from, **to_json(scores)}, indent=1)
            if self.json == STANDARD_OUTPUT:
                print(text)
                return
            write_text(self.json, text)
            console.print(f"wrote {self.json}")
