"""Commands for tests with planted entries: small inputs, and slow results computed once and cached."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from carts_core.cli import calibrate
from carts_core.cli.command_line import main
from carts_core.lab.benchmark import Measurement, Run, Score, hand_eye, measurement, runner
from carts_core.lab.synthesis import synthesize
from carts_core.lab.synthesis.synthesize import _Tracing
from carts_core.lab.training.training import train
from carts_core.settings import Architecture, ImageSettings, SynthesisConfig, TrainingConfig

Command = Callable[[Path], None]
"""Does its work in a folder that holds `recording`, `source` (which has no sequence file) and `model`."""

SPARE = ["--frames", "001", "--settings", "iterations=1"]
TRAINING = TrainingConfig(
    steps=1,
    batch_size=1,
    validation_samples=1,
    workers=0,
    threads=1,
    architecture=Architecture(widths=(4, 6, 8), encoder_convolutions=(1, 1, 1), decoder_convolutions=(1, 1)),
    images=ImageSettings(width=64, height=48, field_width=80, things=0.0, absent=0.0),
)
SYNTHESIS = SynthesisConfig(domains=("regular",))
SYNTHESIS = replace(
    SYNTHESIS,
    endoscope=replace(SYNTHESIS.endoscope, width=64, height=48, stereo=False),
    motion=replace(SYNTHESIS.motion, frames=2),
    render=replace(SYNTHESIS.render, samples=1, tissue_resolution=64, texture_resolution=64),
)


def _command(*words: str) -> Command:
    def run(work: Path) -> None:
        before = Path.cwd()
        os.chdir(work)
        try:
            main(list(words))
        finally:
            os.chdir(before)

    return run


_kept: dict[Any, Any] = {}


def _once(function: Callable[..., Any], key: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which computes once what has a key."""

    def kept(*arguments: Any) -> Any:
        entry = function, key(*arguments)
        if entry not in _kept:
            _kept[entry] = function(*arguments)
        return _kept[entry]

    return kept


def _calibrate(work: Path) -> None:
    with mock.patch.object(calibrate, "_optimized", _once(calibrate._optimized, lambda *_: None)):
        _command("calibrate", "recording/sequence.toml", *SPARE)(work)


def _train(work: Path) -> None:
    train(TRAINING, work / "out")


def _synthesize(work: Path) -> None:
    with mock.patch.object(_Tracing, "_view", _once(_Tracing._view, lambda _, frame, camera: (frame, camera))):
        synthesize(SYNTHESIS, work / "out")


def _bench(work: Path) -> None:
    def measured(bench: Any, runs: list[Run]) -> list[Measurement]:
        score = Score(0.5, 0.9, 0.9, 0.5, None, None, 1.0)
        return [Measurement(run, score, "converged", "a machine", (score,), (0,)) for run in runs]

    with (
        mock.patch.object(runner.SourceBench, "measure", measured),
        mock.patch.object(hand_eye, "_run", _once(hand_eye._run, lambda condition, seed, _: (condition, seed))),
        mock.patch.object(measurement, "render_figures", lambda *_: {"a": 1.0}),
        mock.patch.object(measurement, "network_figures", lambda *_: {"b": 1.0}),
        mock.patch.object(measurement, "optimizer_figures", lambda *_: {"c": 1.0}),
    ):
        _command("bench", "--quick")(work)


WITH_SEQUENCE = {
    "render": ["render", "--frames", "001"],
    "render to a folder": ["render", "--frames", "001", "--output", "out", "--style", "mask"],
    "optimize": ["optimize", "--solver", "none", "--frames", "001"],
    "optimize to a folder": ["optimize", "--solver", "none", "--overwrite", "--output", "out"],
    "export masks": ["export", "exports/out", "--format", "masks", "--overwrite"],
    "export csv": ["export", "exports/out.csv", "--format", "csv", "--overwrite"],
    "export video": ["export", "exports/out", "--format", "video"],
    "evaluate": ["evaluate", "--solver", "none", "--frames", "001", "--json", "scores/out.json"],
}
COMMANDS: dict[str, Command] = {
    **{name: _command(words[0], "recording/sequence.toml", *words[1:]) for name, words in WITH_SEQUENCE.items()},
    "calibrate": _calibrate,
    "train": _train,
    "synthesize": _synthesize,
    "bench": _bench,
    "import": _command("import", "source", "--output", "imported/out", "--overwrite"),
    "robot": _command("robot", "model", "--instrument", "400093", "--output", "robots/out.urdf", "--overwrite"),
}
FOLLOWED = {
    **{name: ["out"] for name in ("render to a folder", "optimize to a folder", "train")},
    **{name: ["exports"] for name in COMMANDS if name.startswith("export")},
    "evaluate": ["scores"],
    "import": ["imported"],
    "robot": ["robots"],
}
"""What a person named, links on the way to which are followed: with `export`, the folder that the output lies in."""
