"""Import structure of the two packages."""

import ast
from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("carts_core", "carts_viewer")


def _sources() -> dict[str, Path]:
    """Every module of the packages by its dotted name."""
    paths = (path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}


def imports(name: str, source: str, *, package: bool, modules: frozenset[str]) -> set[str]:
    """The modules that a module imports anywhere in its text, for type checkers included.

    A package that re-exports what its modules define imports them, and they do not import it; so `from package import
    module` counts as an import of the module alone.
    """
    found: set[str] = set()
    here = name.split(".") if package else name.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = here[: len(here) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                found.add(f"{base}.{alias.name}" if f"{base}.{alias.name}" in modules else base)
    return (found & modules) - {name}


def cycle(graph: Mapping[str, set[str]]) -> list[str]:
    """Modules that import one another in a circle, the first one also at the end; empty when there is no circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_no_module_imports_itself_through_others() -> None:
    sources = _sources()
    modules = frozenset(sources)
    graph = {
        name: imports(name, path.read_text(encoding="utf-8"), package=path.stem == "__init__", modules=modules)
        for name, path in sources.items()
    }
    assert len(graph) > 200 and sum(map(len, graph.values())) > 500
    assert cycle(graph) == []


def test_onnx_runtime_is_imported_only_where_its_telemetry_is_switched_off() -> None:
    found = []
    for name, path in _sources().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            if any(one.split(".")[0] == "onnxruntime" for one in names):
                found.append(name)
    assert set(found) == {"carts_core.onnx_runtime"}
