"""Names given to `carts synthesize` that try to lead elsewhere: it makes the folder it was asked for, nothing else."""

from pathlib import Path

import pytest
from hostile_recording import campaign

SMALL = ["--endoscope.width", "48", "--endoscope.height", "36", "--motion.frames", "1", "--domains", "regular"]
SMALL += ["--render.samples", "1", "--render.tissue-resolution", "64", "--render.texture-resolution", "64"]
OPTIONS = ("--name", "--robot", "--tip-link", "--domains")


def attack(work: Path, number: int, name: str) -> tuple[list[list[str]], tuple[str, ...]]:
    """Synthesize with a hostile name."""
    return [["synthesize", "made", *SMALL, f"{OPTIONS[number % len(OPTIONS)]}={name}"]], ("made",)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_500_hostile_names_to_synthesize(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert campaign(tmp_path_factory.mktemp("sandbox"), monkeypatch, 500, attack) > 20
