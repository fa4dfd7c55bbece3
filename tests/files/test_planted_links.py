"""Links and special files at every path that commands write or read: none is followed, nothing outside is changed."""

import random
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from commands_at_work import COMMANDS, FOLLOWED
from dvrk_tree import write_model
from planted import PLANTED, PRECIOUS, SPECIAL, contents, plant, treasure
from tracing import places, read_places, traced

from carts_core.cli.command_line import BAD_INPUT
from carts_core.errors import CartsError

INPUTS = ("recording", "source", "model")
SECONDS = 120
"""No command waits for a pipe, or reads a device without end."""


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=2).parent


def _fresh(recording: Path, folder: Path) -> tuple[Path, Path]:
    """Folder with all inputs, and unrelated files in another folder."""
    work = folder / "work"
    shutil.copytree(recording, work / "recording")
    shutil.copytree(recording, work / "source", ignore=shutil.ignore_patterns("sequence.toml", "truth.csv", "masks"))
    write_model(work / "model")
    return work, treasure(folder / "home")


def _refused_or_done(name: str, work: Path, what: object) -> None:
    """Run a command to completion, or until it ends with an error message."""
    signal.alarm(SECONDS)
    try:
        COMMANDS[name](work)
    except SystemExit as stop:
        assert stop.code == BAD_INPUT, what
    except CartsError:
        pass
    finally:
        signal.alarm(0)


def _attack(name: str, recording: Path, folder: Path, sample: int | None, *, inputs: bool = False) -> int:
    """Plant each kind at each place that a command writes, or reads, and run it; the number of runs."""
    work, _ = _fresh(recording, folder / "trace")
    with traced() as trace:
        COMMANDS[name](work)
    if inputs:
        found, kinds = [place for place in read_places(trace, work) if place.parts[0] in INPUTS], SPECIAL
    else:
        found = [place for place in places(trace.written, work) if str(place) not in FOLLOWED.get(name, [])]
        kinds = tuple(PLANTED)
        assert found, "nothing was written"
    attacks = [(place, kind) for place in found for kind in kinds]
    if sample is not None:
        attacks = random.Random(name).sample(attacks, min(sample, len(attacks)))
    for number, (place, kind) in enumerate(attacks):
        work, home = _fresh(recording, folder / str(number))
        plant(kind, work / place, home)
        before, given = contents(home), [contents(work / one) for one in INPUTS]
        _refused_or_done(name, work, (place, kind))
        assert contents(home) == before, (place, kind)
        assert [contents(work / one) for one in INPUTS] == given, (place, kind)
        if kind == "folder" and not inputs:
            assert (work / place / "own.txt").read_text() == PRECIOUS, (place, kind)
        shutil.rmtree(folder / str(number))
    print(f"{name}: {'read' if inputs else 'written'}: {len(found)} places, {len(attacks)} runs")
    return len(attacks)


@pytest.mark.parametrize("name", ["render", "optimize", "export masks", "import", "robot"])
def test_nothing_planted_is_followed(name: str, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert _attack(name, recording, tmp_path_factory.mktemp("attacks"), sample=2) == 2


@pytest.mark.parametrize("name", ["render", "import", "robot"])
def test_special_files_as_inputs_are_refused(
    name: str, recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    assert _attack(name, recording, tmp_path_factory.mktemp("attacks"), sample=2, inputs=True) == 2


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", COMMANDS)
def test_no_planted_link_is_followed(name: str, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert _attack(name, recording, tmp_path_factory.mktemp("attacks"), sample=None) >= len(PLANTED)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("train", "synthesize", "bench")])
def test_no_special_file_is_read_anywhere(name: str, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert _attack(name, recording, tmp_path_factory.mktemp("attacks"), sample=None, inputs=True) >= len(SPECIAL)
