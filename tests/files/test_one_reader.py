"""Files of others are read by `carts_core.files.reading` alone: the source is searched for calls that read a path."""

import ast
from collections.abc import Iterator
from pathlib import Path

import carts_core

PACKAGE = Path(carts_core.__file__).parent
READERS = {"read_text", "read_bytes", "imread", "loadtxt", "genfromtxt", "fromfile", "loadmat"}
ALLOWED = {
    "files": "decides what may be read",
    "project": "reads its own database, lock and log",
    "lab/benchmark/measurement.py": "reads the source of the package and the machine's description",
    "lab/benchmark/statistics.py": "reads tables of the package",
    "lab/synthesis": "reads what it wrote",
    "cli/optimizing.py": "reads what an earlier run of the same command wrote",
    "provenance.py": "reads the source of the package, and what an earlier run of the same command wrote",
    "recording/importing/writing.py": "reads back the sequence that it writes",
}


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if not any(name == allowed or name.startswith(f"{allowed}/") for allowed in ALLOWED):
            yield name, ast.parse(path.read_text(encoding="utf-8"))


def reading_calls(module: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of every call that reads a path by itself; a plain call is that of `files.reading`."""
    for node in ast.walk(module):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr in READERS:
                yield node.lineno, node.func.attr
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "open":
            yield node.lineno, "open"


def test_no_other_module_reads_files_of_others():
    found = [f"{name}:{line} {call}" for name, module in _modules() for line, call in reading_calls(module)]
    assert found == [], f"read through carts_core.files.reading: {found}"
