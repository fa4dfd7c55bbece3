"""Every command and Python block of the documentation runs, with an empty HOME and relative paths, from elsewhere."""

import ast
import importlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
import tyro
from doc_blocks import ROOT, all_blocks
from run_doc_blocks import run_command

from carts_core.cli.command_line import any_command

RUNNABLE = {"python", "console", "bash"}
TESTED_ELSEWHERE = {"toml", "sql"}
"""By test_sequence_format_docs.py and test_project_docs.py."""
NO_PROGRAMS = {"json", "text", ""}
SLOW = {
    "docs/howto/calibration.md",
    "docs/howto/exports.md",
    "docs/howto/import.md",
    "docs/howto/masks.md",
    "docs/howto/prompt.md",
    "docs/howto/sequences.md",
    "docs/reference/exports.md",
    "docs/reference/project_file.md",
    "docs/reference/sequence_format.md",
    "docs/tutorial/python.md",
}
"""Pages whose blocks run in the slow tests; that commands and imports of all pages are understood is always tested."""
SECONDS = 280

TO_RUN = {
    page: list(group)
    for page, group in groupby(
        (block for block in all_blocks() if block.language in RUNNABLE and block.reason is None),
        key=lambda block: block.page,
    )
}


@pytest.fixture
def reader(tmp_path: Path, tiny_sequence: Callable[..., Path]) -> tuple[Path, dict[str, str]]:
    """Folder with the files that the pages refer to, and the environment of a new user."""
    recording = tiny_sequence(edit=lambda text: text.replace('name = "tiny"', 'name = "NAME"')).parent
    shutil.copytree(recording, tmp_path / "desk", ignore=shutil.ignore_patterns("desk", "home"))
    desk = tmp_path / "desk"
    shutil.copytree(ROOT / "sample_data", desk / "sample_data")
    foreign = desk / "session"
    shutil.copytree(ROOT / "sample_data" / "sequence" / "images" / "regular" / "left", foreign / "left")
    rows = (ROOT / "sample_data" / "sequence" / "kinematics.csv").read_text().replace("psm1.", "").splitlines()
    columns = [",".join([*row.split(",")[:1], *row.split(",")[2:9]]) for row in rows]
    (foreign / "joints.csv").write_text("\n".join(columns) + "\n")
    (desk / "path").mkdir()
    (desk / "path" / "to").symlink_to(desk)
    home = tmp_path / "home"
    home.mkdir()
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "CARTS_"))}
    # One thread: tests run side by side, and threads that wait for each other take many times longer then.
    return desk, kept | {"HOME": str(home), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def run_blocks(todo: list[list[Any]], reader: tuple[Path, dict[str, str]]) -> subprocess.CompletedProcess[str]:
    """Run blocks (location, language, and text or commands) in a separate process."""
    desk, environment = reader
    return subprocess.run(
        [sys.executable, str(ROOT / "tests" / "documentation" / "run_doc_blocks.py")],
        input=json.dumps(todo),
        cwd=desk,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=SECONDS,
    )


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] if page in SLOW else []) for page in TO_RUN]
)
def test_the_blocks_of_a_page_run(page: str, reader: tuple[Path, dict[str, str]]) -> None:
    todo = [
        [str(block), block.language, block.text if block.language == "python" else block.commands()]
        for block in TO_RUN[page]
    ]
    finished = run_blocks(todo, reader)
    assert finished.returncode == 0, f"{finished.stdout[-2000:]}\n{finished.stderr[-4000:]}"
    assert finished.stdout.count("--- ") == len(todo)


def test_commands_and_imports_of_every_page_are_understood(
    reader: tuple[Path, dict[str, str]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(reader[0])
    for block in all_blocks():
        if block.language == "python":
            for node in ast.walk(ast.parse(block.text)):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else ()
                for name in names:
                    if isinstance(node, ast.ImportFrom):
                        assert hasattr(importlib.import_module(node.module or ""), name), f"{block}: {name}"
                    else:
                        importlib.import_module(name)
        for command in block.commands() if block.language == "console" else ():
            if block.reason is None and command.startswith("carts "):
                try:
                    tyro.cli(any_command(), args=shlex.split(command)[1:])  # pyright: ignore
                except SystemExit as end:
                    assert end.code == 0, f"{block}: {command}\n{capsys.readouterr().err}"


def test_every_block_is_run_marked_or_tested_elsewhere() -> None:
    known = RUNNABLE | TESTED_ELSEWHERE | NO_PROGRAMS
    strange = [block for block in all_blocks() if block.language not in known and not block.language.startswith("{")]
    assert not strange, f"of which language are these? {', '.join(map(str, strange))}"
    assert {"README.md", "docs/tutorial/python.md", "docs/howto/exports.md"} <= set(TO_RUN)


def test_a_block_that_fails_fails_the_test(reader: tuple[Path, dict[str, str]]) -> None:
    finished = run_blocks([["page:1", "python", "1 / 0"]], reader)
    assert finished.returncode != 0 and "page:1" in finished.stderr
    with pytest.raises(SystemExit, match=r"ended with status 2"):
        run_command("carts render missing.toml")
