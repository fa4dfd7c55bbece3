"""Names given to `carts synthesize` that try to lead elsewhere: it makes the folder it was asked for, nothing else."""

import shutil
from pathlib import Path

import pytest
from hostile_recording import hostile_names
from planted import contents, treasure

from carts_core.cli.command_line import BAD_INPUT, main

SMALL = ["--endoscope.width", "48", "--endoscope.height", "36", "--motion.frames", "1", "--domains", "regular"]
SMALL += ["--render.samples", "1", "--render.tissue-resolution", "64", "--render.texture-resolution", "64"]
OPTIONS = ("--name", "--robot", "--tip-link", "--domains")


def campaign(sandbox: Path, monkeypatch: pytest.MonkeyPatch, count: int) -> int:
    """Synthesize with hostile names; how many were made."""
    treasure(sandbox / "home")
    (sandbox / "work").mkdir()
    monkeypatch.chdir(sandbox / "work")
    before, made = contents(sandbox), 0
    for number, name in enumerate(hostile_names(count, sandbox)):
        try:
            main(["synthesize", "made", *SMALL, f"{OPTIONS[number % len(OPTIONS)]}={name}"])
            made += 1
        except SystemExit as stop:
            assert stop.code == BAD_INPUT, (OPTIONS[number % len(OPTIONS)], name)
        shutil.rmtree("made", ignore_errors=True)
        assert contents(sandbox) == before, (OPTIONS[number % len(OPTIONS)], name)
    print(f"{count} names, {made} sequences made; 0 writes outside")
    return made


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_500_hostile_names_lead_nowhere_when_synthesized(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert campaign(tmp_path_factory.mktemp("sandbox"), monkeypatch, 500) > 20
