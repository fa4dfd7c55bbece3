"""Output of `carts` that requires no command appears before slow imports."""

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
    (["optimise"], "there is no command 'optimise'. Did you mean 'optimize'?"),
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
    (["train", "--images.width", "17"], "must be positive multiples of 16"),
    (["export", "sequence.toml", "out", "--format", "cocoo"], "Did you mean 'coco'?"),
    (["render", "sequence.toml", "--style", "ovrelay"], "Did you mean 'overlay'?"),
    (["evaluate", "sequence.toml", "--fraems", "1"], "Perhaps you meant: --frames"),
]


_ANSWER_EACH = """
import contextlib, io, json, sys
from carts_core.cli.command_line import main

for arguments in json.load(sys.stdin):
    said, status = io.StringIO(), 0
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            main(arguments)
        except SystemExit as end:
            status = end.code or 0
    print(json.dumps([status, " ".join(said.getvalue().split()), list(sys.modules)]))
"""


def _answers(every: list[list[str]]) -> list[tuple[int, str, set[str]]]:
    """Status, output in one line, and imported modules after each of these commands, in one new process."""
    finished = subprocess.run(
        [sys.executable, "-c", _ANSWER_EACH], input=json.dumps(every), capture_output=True, text=True, check=True
    )
    found = [json.loads(line) for line in finished.stdout.splitlines()]
    assert len(found) == len(every)
    return [(status, " ".join(text.replace("│", " ").split()), set(modules)) for status, text, modules in found]


def test_help_version_and_wrong_arguments_are_answered_without_heavy_imports() -> None:
    asked = [(["--help"], 0, "usage: carts"), (["--version"], 0, f"carts {version('carts')}")]
    asked += [([name, "--help"], 0, f"usage: carts {name}") for name in COMMANDS]
    asked += [(arguments, BAD_INPUT, message) for arguments, message in WRONG]
    for (arguments, expected, message), found in zip(asked, _answers([each for each, _, _ in asked]), strict=True):
        status, text, modules = found
        assert (status, HEAVY & modules) == (expected, set()), arguments
        assert message in text, arguments
        if arguments == ["--help"]:
            assert all(name in text for name in COMMANDS)
        if arguments in (["optimize", "--help"], ["evaluate", "--help"], ["render", "--help"]):
            assert "from the true joint positions, if known" in text


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
