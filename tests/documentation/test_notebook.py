"""The notebook in `examples` runs unchanged, without a kernel, and shows the described output."""

import ast
import json
import time
import warnings
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from carts_core.evaluation import dice

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "fit_an_image.ipynb"
MAX_LINES, MAX_SECONDS = 10, 60
"""Lines of code, and time, from an image to its corrected mask and plot."""


def code_cells() -> list[str]:
    """The code of each cell; the file must be a notebook of version 4.5 without stored output."""
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert len({cell["id"] for cell in notebook["cells"]}) == len(notebook["cells"])
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    return ["".join(cell["source"]) for cell in cells]


def run_cell(source: str, namespace: dict[str, Any]) -> Any:
    """Run a cell; the value of its last expression, which a kernel would show, or None."""
    tree = ast.parse(source)
    last = tree.body[-1]
    shown = ast.Expression(last.value) if isinstance(last, ast.Expr) and not source.endswith(";") else None
    exec(compile(ast.Module(tree.body[: -1 if shown else None], []), NOTEBOOK.name, "exec"), namespace)
    return None if shown is None else eval(compile(shown, NOTEBOOK.name, "eval"), namespace)


def test_the_notebook_fits_and_shows_an_image() -> None:
    plt.switch_backend("agg")
    namespace: dict[str, Any] = {"__name__": "__main__"}
    cells, began = code_cells(), time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        opened = run_cell(cells[0], namespace)
        run_cell(cells[1], namespace)
        seconds, lines = time.perf_counter() - began, [line for cell in cells[:2] for line in cell.splitlines() if line]
        shown = [run_cell(cell, namespace) for cell in cells[2:]]
    assert plt.get_fignums()
    plt.close("all")
    assert len(lines) <= MAX_LINES and seconds < MAX_SECONDS
    fit, frame = namespace["fit"], namespace["frame"]
    assert fit.verdict == "good" and dice(fit.mask, frame.masks["left"]) > 0.95
    for item in (opened, shown[0], shown[-1]):
        assert "data:image/jpeg;base64," in item._repr_html_() and "<table>" in item._repr_html_()
