"""Only `carts_core.files` opens input files and writes to disk: the source is searched for calls that could."""

import re
from collections.abc import Iterator
from pathlib import Path

import carts_core
import carts_viewer

PACKAGES = [Path(package.__file__ or "").parent for package in (carts_core, carts_viewer)]
READS = re.compile(
    r"\.(read_text|read_bytes|loadtxt|genfromtxt|fromfile|loadmat|imread)\("
    r"|(?<![\w.])(?<!def )open\((?!.*[\"'][wax]b?[\"'])"
)
WRITES = re.compile(
    r"\.(write_text|write_bytes|touch|mkdir|makedirs|renames?|unlink|rmdir|removedirs|symlink_to|hardlink_to|symlink)\("
    r"|\.(mkfifo|mknod|f?truncate|chmod|chown|utime|extract(all)?|tofile|to_csv|imwrite(multi)?|VideoWriter)\("
    r"|\b(rmtree|copyfile|copy2|copytree|mkstemp|mkdtemp|NamedTemporaryFile|FileStorage|flock|lockf|save_file)\("
    r"|\b(os\.(remove\b|link\b|replace\b|open\((?!os\.devnull))|sqlite3\.connect\b|(path|part|partial)\.replace\([^,\"]*\))"
    r"|(?<!onnx)\.(save|savez(_compressed)?|savetxt|savefig|export)\((?!\s*(\)|stream|file|figures|content))"
    r"|(?<!webbrowser\.)\bopen\((?!file|stream).*[\"'][rbt]*[wax+][rbt+]*[\"']"
)
READ_ELSEWHERE = {
    "carts_core/project": "reads its own database, lock and log",
    "carts_core/lab/benchmark/measurement.py": "reads the source of the package and the machine's description",
    "carts_core/lab/benchmark/statistics.py": "reads tables of the package",
    "carts_core/lab/synthesis": "reads what it wrote",
    "carts_core/cli/optimizing.py": "reads what an earlier run of the same command wrote",
    "carts_core/provenance.py": "reads the source of the package, and what an earlier run of the same command wrote",
    "carts_core/recording/importing/writing.py": "reads back the sequence that it writes",
    "carts_viewer": "reads its own files beside a recording through `carts_core.files`",
}
WRITTEN_ELSEWHERE = {
    "carts_core/project": "SQLite writes the project by itself; tests/project attacks its path, its lock and its log",
    "carts_viewer/serving.py": "chmod of a page in a temporary folder that this user alone may look into",
}


def calls(pattern: re.Pattern[str], elsewhere: dict[str, str]) -> Iterator[str]:
    """Where in both packages there is such a call."""
    for package in PACKAGES:
        for path in sorted(package.rglob("*.py")):
            name = path.relative_to(package.parent).as_posix()
            if name.startswith(("carts_core/files/", *elsewhere)):
                continue
            text = path.read_text(encoding="utf-8")
            for match in pattern.finditer(text):
                yield f"{name}:{text.count(chr(10), 0, match.start()) + 1}: {match[0]}"


def test_no_other_module_opens_input_files() -> None:
    assert list(calls(READS, READ_ELSEWHERE)) == []


def test_no_other_module_writes_to_a_path() -> None:
    assert list(calls(WRITES, WRITTEN_ELSEWHERE)) == []
