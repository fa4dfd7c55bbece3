"""A full disk refuses edits and harms nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


def _run_on_a_full_disk(folder: Path, how: str, *prefix: str) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [*prefix, sys.executable, str(Path(__file__).with_name("full_disk.py")), str(folder), how]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("kept ")


def test_a_file_that_may_not_grow_refuses_edits_and_keeps_what_it_has(tmp_path: Path) -> None:
    _run_on_a_full_disk(tmp_path, "limit")


def test_a_full_disk_refuses_edits_and_keeps_what_it_has(tmp_path: Path) -> None:
    own_mounts = ("unshare", "--map-root-user", "--mount")
    try:
        subprocess.run([*own_mounts, "mount", "-t", "tmpfs", "none", str(tmp_path)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this machine lets nobody mount a small disk")
    _run_on_a_full_disk(tmp_path, "tmpfs", *own_mounts)
