"""Names in a recording that try to lead elsewhere, through every command: nothing is written outside the output."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile_recording import WHERE, Attack, campaign, with_name

COMMANDS: dict[str, list[str]] = {
    "render": ["render", "--positions", "1"],
    "optimize": ["optimize", "--positions", "1", "--solver", "none"],
    "export masks": ["export", "out/masks", "--format", "masks"],
    "export csv": ["export", "out/table.csv", "--format", "csv"],
    "evaluate": ["evaluate", "--positions", "1", "--solver", "none", "--json", "out/scores.json"],
    "calibrate": ["calibrate", "--positions", "1", "--settings", "iterations=1"],
}
OUTPUTS = ("runs", "out")
"""Output folders of the commands: the default, and those of the command lines above."""


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=1, masks=False, truth=False).parent


def on(recording: Path, *commands: str) -> Attack:
    """Commands on a copy of the recording with a hostile name in it."""

    def attack(work: Path, number: int, name: str) -> tuple[list[list[str]], tuple[str, ...]]:
        where = WHERE[number % len(WHERE)]
        shutil.copytree(recording, work / "recording")
        file, table = work / "recording" / "sequence.toml", work / "recording" / "kinematics.csv"
        file.write_text(with_name(file.read_text(), where, name), encoding="utf-8", errors="surrogatepass")
        if where == "frame":
            header, row = table.read_text().splitlines()
            quoted = '"' + name.replace('"', '""') + '"'
            table.write_text(f"{header}\n{quoted},{row.split(',', 1)[1]}\n", encoding="utf-8")
        lines = [COMMANDS[command] for command in commands]
        return [[words[0], "recording/sequence.toml", *words[1:]] for words in lines], OUTPUTS

    return attack


def test_hostile_names_lead_nowhere(
    recording: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign(tmp_path_factory.mktemp("sandbox"), monkeypatch, 10, on(recording, "render", "export csv"))


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("command", COMMANDS)
def test_500_hostile_names_lead_nowhere_through_any_command(
    command: str, recording: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    accepted = campaign(tmp_path_factory.mktemp("sandbox"), monkeypatch, 500, on(recording, command))
    assert accepted > 50, "most names were not even tried"
