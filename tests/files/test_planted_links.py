"""Links and special files at every path that the commands write: none is followed, nothing outside is changed."""

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from planted import PLANTED, PRECIOUS, contents, plant, treasure
from tracing import places, traced

from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.errors import CartsError
from carts_core.lab.training.training import train
from carts_core.settings import Architecture, ImageSettings, TrainingConfig

QUICK = ["--frames", "0", "--blurs", "0.8", "--looks", "1", "--stage-iterations", "1"]


def _train(work: Path) -> None:
    images = ImageSettings(width=64, height=48, field_width=80, things=0.0, absent=0.0)
    architecture = Architecture(widths=(4, 6, 8), encoder_convolutions=(1, 1, 1), decoder_convolutions=(1, 1))
    config = TrainingConfig(
        steps=1, batch_size=1, validation_samples=1, workers=0, threads=1, architecture=architecture, images=images
    )
    train(config, work / "out")


def _command(*words: str) -> Callable[[Path], None]:
    def run(work: Path) -> None:
        before = Path.cwd()
        os.chdir(work)
        try:
            main([words[0], "recording/sequence.toml", *words[1:]])
        finally:
            os.chdir(before)

    return run


COMMANDS: dict[str, Callable[[Path], None]] = {
    "render": _command("render", "--frames", "0"),
    "render to a folder": _command("render", "--frames", "0", "--output", "out", "--style", "mask"),
    "optimize": _command("optimize", "--solver", "none", "--frames", "0"),
    "optimize to a folder": _command("optimize", "--solver", "none", "--overwrite", "--output", "out"),
    "export masks": _command("export", "exports/out", "--format", "masks", "--overwrite"),
    "export csv": _command("export", "exports/out.csv", "--format", "csv", "--overwrite"),
    "export video": _command("export", "exports/out", "--format", "video"),
    "calibrate": _command("calibrate", *QUICK),
    "evaluate": _command("evaluate", "--solver", "none", "--frames", "0", "--json", "scores/out.json"),
    "train": _train,
}
FOLLOWED = {"render to a folder": ["out"], "optimize to a folder": ["out"], "train": ["out"], "evaluate": ["scores"]}
"""What a person named, links on the way to which are followed: with `export`, the folder that the output lies in."""
FOLLOWED |= {name: ["exports"] for name in COMMANDS if name.startswith("export")}


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=2).parent


def _fresh(recording: Path, folder: Path) -> tuple[Path, Path]:
    """A folder with the recording in it, and somebody's own files elsewhere."""
    shutil.copytree(recording, folder / "work" / "recording")
    return folder / "work", treasure(folder / "home")


def _attack(name: str, recording: Path, folder: Path, sample: int | None) -> int:
    """Plant each kind at each place that a command writes, and run it; the number of runs."""
    work, _ = _fresh(recording, folder / "trace")
    with traced() as trace:
        COMMANDS[name](work)
    found = [place for place in places(trace, work) if str(place) not in FOLLOWED.get(name, [])]
    assert found, "nothing was written"
    attacks = [(place, kind) for place in found for kind in PLANTED]
    if sample is not None:
        attacks = random.Random(name).sample(attacks, min(sample, len(attacks)))
    for number, (place, kind) in enumerate(attacks):
        work, home = _fresh(recording, folder / str(number))
        plant(kind, work / place, home)
        before, images = contents(home), contents(work / "recording")
        try:
            COMMANDS[name](work)
        except SystemExit as stop:
            assert stop.code == BAD_INPUT, (place, kind)
        except CartsError:
            pass
        assert contents(home) == before, (place, kind)
        assert contents(work / "recording") == images, (place, kind)
        if kind == "folder":
            assert (work / place / "own.txt").read_text() == PRECIOUS, (place, kind)
        shutil.rmtree(folder / str(number))
    print(f"{name}: {len(found)} places, {len(attacks)} runs")
    return len(attacks)


@pytest.mark.parametrize("name", ["render", "optimize", "export masks"])
def test_nothing_planted_is_followed(name: str, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert _attack(name, recording, tmp_path_factory.mktemp("attacks"), sample=3) == 3


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", COMMANDS)
def test_nothing_planted_anywhere_is_followed(
    name: str, recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert _attack(name, recording, tmp_path_factory.mktemp("attacks"), sample=None) >= len(PLANTED)
