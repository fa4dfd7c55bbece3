"""Names in a recording that try to lead elsewhere, through every command: nothing is written outside the output."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hostile_recording import WHERE, hostile_names, with_name
from planted import contents, treasure

from carts_core.cli.command_line import BAD_INPUT, main

COMMANDS: dict[str, list[str]] = {
    "render": ["render", "--positions", "1"],
    "optimize": ["optimize", "--positions", "1", "--solver", "none"],
    "export masks": ["export", "out/masks", "--format", "masks"],
    "export csv": ["export", "out/table.csv", "--format", "csv"],
    "evaluate": ["evaluate", "--positions", "1", "--solver", "none", "--json", "out/scores.json"],
    "calibrate": ["calibrate", "--positions", "1", "--settings", "iterations=1"],
}
OUTPUTS = ("runs", "out")
"""Where commands write: the default, and what the command lines above name."""


def _outside(sandbox: Path) -> dict[str, str]:
    """Everything but the outputs."""
    found = contents(sandbox)
    return {name: what for name, what in found.items() if not name.startswith(tuple(f"work/{one}" for one in OUTPUTS))}


def _run_all(recording: Path, sandbox: Path, name: str, where: str, commands: list[str]) -> int:
    """Run commands on a recording with a hostile name; how many accepted it."""
    work = sandbox / "work"
    for output in OUTPUTS:
        shutil.rmtree(work / output, ignore_errors=True)
    file, table = work / "recording" / "sequence.toml", work / "recording" / "kinematics.csv"
    text = (recording / "sequence.toml").read_text()
    file.write_text(with_name(text, where, name), encoding="utf-8", errors="surrogatepass")
    if where == "frame":
        header, row = (recording / "kinematics.csv").read_text().splitlines()
        quoted = '"' + name.replace('"', '""') + '"'
        table.write_text(f"{header}\n{quoted},{row.split(',', 1)[1]}\n", encoding="utf-8")
    else:
        shutil.copy(recording / "kinematics.csv", table)
    before, accepted = _outside(sandbox), 0
    for command in commands:
        words = COMMANDS[command]
        try:
            main([words[0], "recording/sequence.toml", *words[1:]])
            accepted += 1
        except SystemExit as stop:
            assert stop.code == BAD_INPUT, (command, where, name)
        assert _outside(sandbox) == before, (command, where, name)
    return accepted


def _campaign(
    recording: Path, sandbox: Path, monkeypatch: pytest.MonkeyPatch, count: int, commands: list[str]
) -> tuple[int, int]:
    treasure(sandbox / "home")
    (sandbox / "work").mkdir()
    shutil.copytree(recording, sandbox / "work" / "recording")
    monkeypatch.chdir(sandbox / "work")
    runs = accepted = 0
    for number, name in enumerate(hostile_names(count, sandbox)):
        accepted += _run_all(recording, sandbox, name, WHERE[number % len(WHERE)], commands)
        runs += len(commands)
        if number % 50 == 49 or number == count - 1:
            print(f"{number + 1} names, {runs} runs, {accepted} of them to the end; 0 writes outside", flush=True)
    return runs, accepted


@pytest.fixture
def recording(tiny_sequence: Callable[..., Path]) -> Path:
    return tiny_sequence(frames=1, masks=False, truth=False).parent


def test_hostile_names_lead_nowhere(
    recording: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, _ = _campaign(recording, tmp_path_factory.mktemp("sandbox"), monkeypatch, 10, ["render", "export csv"])
    assert runs == 20


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("command", COMMANDS)
def test_500_hostile_names_lead_nowhere_through_any_command(
    command: str, recording: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    sandbox = tmp_path_factory.mktemp("sandbox")
    runs, accepted = _campaign(recording, sandbox, monkeypatch, 500, [command])
    assert runs == 500 and accepted > 50, "most names were not even tried"
    assert sorted(os.listdir(sandbox)) == ["home", "work"]
