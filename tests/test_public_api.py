"""Public interface: every name can be imported and is documented; import rules and safety rules hold in every
file."""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import carts_core
import carts_viewer
from carts_core.resources import static_dir

ROOTS = [Path(package.__path__[0]) for package in (carts_core, carts_viewer)]
SOURCES = sorted(path for root in ROOTS for path in root.rglob("*.py"))
CORE_SOURCES = [path for path in SOURCES if path.is_relative_to(ROOTS[0])]
# The one place where the core reaches for the app: `carts view`, when it is called and not before.
COMMAND_LINE = ROOTS[0] / "cli" / "view.py"


def _named(path: Path) -> str:
    return path.relative_to(ROOTS[0].parent).as_posix()


def _module(path: Path) -> str:
    """The dotted name under which a source file is imported."""
    return _named(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def _tree(path: Path) -> ast.Module:
    """Parsed file, which must not be changed."""
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def _imports(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Every module that is imported anywhere below, absolute, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module, node.lineno


# One test for all files, not one for each: a test costs more than the look at a file.


def test_every_module_imports_with_all_its_public_names() -> None:
    missing = []
    for module in (_module(path) for path in SOURCES if path.name != "__main__.py"):
        imported = importlib.import_module(module)
        missing += [
            f"{module}.{name}"
            for name in {*getattr(imported, "__all__", ()), *dir(imported)}
            if not hasattr(imported, name)
        ]
    assert not missing, f"named in __all__ or __dir__ and not there: {', '.join(missing)}"


def test_the_core_does_not_know_the_viewer() -> None:
    wrong = []
    for path in CORE_SOURCES:
        tree: ast.AST = _tree(path)
        if path == COMMAND_LINE:
            # Bodies of functions run when they are called; what remains runs on import.
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for scope in (tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))):
                scope.body = [node for node in scope.body if not isinstance(node, ast.FunctionDef)]
        wrong += [
            f"{_named(path)}:{line} imports {name}"
            for name, line in _imports(tree)
            if name.split(".")[0] in {"viser", "carts_viewer"}
        ]
    assert not wrong, ", ".join(wrong)


def test_importing_the_whole_core_loads_no_web_toolkit() -> None:
    imports = "; ".join(f"import {_module(path)}" for path in CORE_SOURCES if path.name != "__main__.py")
    check = "import sys; loaded = {'viser', 'carts_viewer'} & set(sys.modules); assert not loaded, loaded"
    finished = subprocess.run(
        [sys.executable, "-c", f"{imports}; {check}"], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr


def _hazards(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Lines that could run code from a data file, or open the server to the network."""
    for name, line in _imports(tree):
        if name.split(".")[0] in {"pickle", "dill", "cloudpickle", "shelve", "marshal"}:
            yield line, f"imports {name}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in {"eval", "exec", "torch.load", "os.system"}:
                yield node.lineno, f"calls {called}"
            for keyword in node.keywords:
                on = isinstance(keyword.value, ast.Constant) and keyword.value.value is True
                if on and keyword.arg in {"allow_pickle", "shell"}:
                    yield node.lineno, f"passes {keyword.arg}=True"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and "0.0.0.0" in node.value:
            yield node.lineno, "names the address of every network interface"


def test_no_file_runs_code_from_data_or_listens_on_every_interface() -> None:
    assert [f"{_named(path)}:{line} {what}" for path in SOURCES for line, what in _hazards(_tree(path))] == []


_MARKUP = re.compile(
    r"(?P<sink>\.(?:innerHTML|outerHTML|srcdoc)\s*\+?=(?!=)|insertAdjacentHTML|createContextualFragment|document\.write|"
    r"\beval\(|\bnew Function|[sS]etAttribute\(\s*[\"'`]on)\s*(?P<constant>(?:`[^`$]*`|\"[^\"]*\"|'[^']*');)?"
)
"""Places where JavaScript converts text to HTML or code; constants are allowed."""


def _markup(source: str) -> list[str]:
    """Lines of JavaScript that make HTML or code of something that is not a constant."""
    found = [match for match in _MARKUP.finditer(source) if not match["constant"]]
    return [f"{source.count(chr(10), 0, match.start()) + 1}: {match['sink']}" for match in found]


def test_no_script_makes_html_or_code_of_a_text() -> None:
    scripts = {path.name: path.read_text(encoding="utf-8") for path in static_dir().glob("*.js")}
    for path in SOURCES:
        strings = [node.value for node in ast.walk(_tree(path)) if isinstance(node, ast.Constant)]
        scripts[_named(path)] = "\n".join(value for value in strings if isinstance(value, str))
    assert {name: found for name, source in scripts.items() if (found := _markup(source))} == {}
