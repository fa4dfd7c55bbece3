"""What `carts` says without running a command is said at once: before anything is imported that takes long."""

import json
import os
import subprocess
import sys
from importlib.metadata import version

import pytest

from carts_core.cli.command_line import BAD_INPUT

HEAVY = {"torch", "numba", "cv2", "kornia", "scipy", "trimesh", "matplotlib", "viser", "mitsuba"}
COMMANDS = (
    *("view", "optimize", "evaluate", "calibrate", "hand-eye", "render", "export", "synthesize", "train", "bench"),
    "batch",
    "live",
    "time-offset",
    "import-masks",
)

WRONG: list[tuple[list[str], str]] = [
    (["optimize"], "PATH"),
    (["optimize", "sequence.toml", "--seed", "many"], "--seed"),
    (["evaluate", "sequence.toml", "--solver", "newton"], "--solver"),
    (["evaluate", "sequence.toml", "--settings", "iterations=0"], "iterations is 0; allowed: 1 to 10000"),
    (["optimize", "sequence.toml", "--perturb-deg", "-3"], "--perturb-deg is -3.0; allowed: 0 to 180"),
    (["evaluate", "sequence.toml", "--perturb-deg", "nan"], "--perturb-deg is nan; allowed: 0 to 180"),
    (["render", "sequence.toml", "--seed", "-1"], "--seed is -1; allowed: 0 or more"),
    (["optimize", "sequence.toml", "--keyframes", "table.csv"], "requires --mode sequence"),
    (["evaluate", "sequence.toml", "--json", "/"], "--json / is a folder. Give a file."),
    (["evaluate", "sequence.toml", "--json", "/dev/null/scores.json"], "/dev/null cannot be created or written"),
    (
        ["evaluate", "sequence.toml", "--mode", "sequence", "--solver", "acs"],
        "--mode sequence requires --solver surface, but --solver acs was given",
    ),
    (["calibrate", "sequence.toml", "--settings", "loss=l1"], "has no setting 'loss'"),
    (["synthesize", "out", "--motion.frames", "0"], "MotionConfig.frames is 0"),
    (["train", "--images.width", "17"], "give positive multiples of 16"),
    (["export", "sequence.toml", "out", "--format", "cocoo"], "Did you mean 'coco'?"),
    (["render", "sequence.toml", "--style", "ovrelay"], "Did you mean 'overlay'?"),
    (["evaluate", "sequence.toml", "--fraems", "1"], "Perhaps you meant: --frames"),
]


def _answer(*arguments: str) -> tuple[int, str, set[str]]:
    """Exit status, what was printed, and all modules that were imported."""
    command = [sys.executable, "-X", "importtime", "-m", "carts_core.cli", *arguments]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = finished.stderr.splitlines()
    modules = {line.rpartition("|")[2].strip() for line in lines if line.startswith("import time:")}
    errors = [line for line in lines if not line.startswith("import time:")]
    assert "carts_core.cli" in modules or "carts_core.cli.optimize" in modules
    return finished.returncode, " ".join((finished.stdout + "\n".join(errors)).split()), modules


_ANSWER_EACH = """
import contextlib, io, json, sys
from carts_core.cli.command_line import main

for arguments in json.load(sys.stdin):
    said, status = io.StringIO(), None
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            main(arguments)
        except SystemExit as end:
            status = end.code
    print(json.dumps([status, " ".join(said.getvalue().split()), list(sys.modules)]))
"""


def _answers(every: list[list[str]]) -> list[tuple[int, str, set[str]]]:
    """The same of one process that is asked for one after another: starting one takes longer than the answer."""
    finished = subprocess.run(
        [sys.executable, "-c", _ANSWER_EACH],
        input=json.dumps(every),
        capture_output=True,
        text=True,
        check=True,
    )
    found = [json.loads(line) for line in finished.stdout.splitlines()]
    assert len(found) == len(every)
    return [(status, text, set(modules)) for status, text, modules in found]


def test_help_is_given_without_heavy_imports() -> None:
    status, text, modules = _answer("--help")
    assert status == 0 and "usage: carts" in text and not HEAVY & modules and all(name in text for name in COMMANDS)
    for name, (status, text, modules) in zip(COMMANDS, _answers([[name, "--help"] for name in COMMANDS]), strict=True):
        assert (status, HEAVY & modules) == (0, set()), name
        assert f"usage: carts {name}" in text
        if name in ("optimize", "evaluate", "render"):
            said = " ".join(text.replace("│", " ").split())
            assert "from the true joint positions, if known" in said, name


def test_a_wrong_argument_is_reported_without_heavy_imports() -> None:
    status, text, modules = _answer("optimise")
    assert status == BAD_INPUT and "there is no command 'optimise'. Did you mean 'optimize'?" in text
    assert not HEAVY & modules
    for (arguments, message), found in zip(WRONG, _answers([arguments for arguments, _ in WRONG]), strict=True):
        status, text, modules = found
        assert (status, HEAVY & modules) == (BAD_INPUT, set()), arguments
        assert message in " ".join(text.replace("│", " ").split())


def test_the_version_is_told_without_heavy_imports() -> None:
    status, text, modules = _answer("--version")
    assert (status, text) == (0, f"carts {version('carts')}") and not HEAVY & modules


@pytest.mark.parametrize("arguments", [["optimize", "--help"], ["optimise"]])
def test_output_that_nobody_reads_ends_quietly(arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        command = [sys.executable, "-m", "carts_core.cli", *arguments]
        finished = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, check=False)
    finally:
        os.close(writing)
    assert finished.returncode == (BAD_INPUT if arguments == ["optimise"] else 1)
    assert b"Traceback" not in finished.stderr and b"BrokenPipe" not in finished.stderr
