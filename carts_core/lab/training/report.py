"""The training report: curves, example predictions and a page that shows both."""

import json
import math
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ...console import in_markdown
from ...files import OutputPath, output_stream, write_text
from ...wording import counted
from .checkpoint import History

matplotlib.use("Agg")

Panels = list[list[tuple[str, np.ndarray]]]
"""Per sample, titled pictures; one without colours runs from -1 to 1."""


def write_report(folder: OutputPath, config: dict, history: History, columns: dict[str, str], examples: Panels) -> Path:
    """Write `curves.png`, `predictions.jpg` and `README.md`; returns the path of the page."""
    with output_stream(folder / "curves.png") as stream:
        _curves(history, columns).savefig(stream, format="png", dpi=110)
    with output_stream(folder / "predictions.jpg") as stream:
        _predictions(examples).savefig(stream, format="jpg", dpi=110, pil_kwargs={"quality": 85})
    page = folder / "README.md"
    write_text(page, _page(config, history, columns))
    return page.path


def _curves(history: History, columns: dict[str, str]) -> Figure:
    figure = Figure(figsize=(3.3 * (1 + len(columns)), 3.4), layout="constrained")
    loss_axes, *others = figure.subplots(1, 1 + len(columns))
    steps = [entry["step"] for entry in history.losses]
    for name in history.losses[0] if history.losses else ():
        if name not in ("step", "loss"):
            values = [entry[name] for entry in history.losses]
            loss_axes.plot(steps, values, label=name.replace("_", " "), linewidth=0.9)
    loss_axes.set(title="training loss, per term", xlabel="step", yscale="log")
    if loss_axes.lines:
        loss_axes.legend(fontsize=8)
    steps = [entry["step"] for entry in history.validations]
    for axes, (name, title) in zip(others, columns.items(), strict=True):
        axes.plot(steps, [entry.get(name, math.nan) for entry in history.validations], ".-")
        axes.set(title=f"validation: {title}", xlabel="step")
    for axes in (loss_axes, *others):
        axes.grid(alpha=0.3)
        axes.title.set_fontsize(9)
    return figure


def _predictions(examples: Panels) -> Figure:
    titles = [title for title, _ in examples[0]]
    figure = Figure(figsize=(2.2 * len(titles), 1.75 * len(examples)), layout="constrained")
    rows = figure.subplots(len(examples), len(titles), squeeze=False)
    for row, panels in zip(rows, examples, strict=True):
        for axes, (_, panel) in zip(row, panels, strict=True):
            flat = panel.ndim == 2
            axes.imshow(panel, vmin=-1 if flat else None, vmax=1 if flat else None, cmap="RdYlGn")
            axes.set_axis_off()
    for axes, title in zip(rows[0], titles, strict=True):
        axes.set_title(title, fontsize=9)
    return figure


def _page(config: dict, history: History, columns: dict[str, str]) -> str:
    steps = int(history.losses[-1]["step"]) if history.losses else 0
    lines = [
        f"# Training of the {config['network']} network",
        "",
        f"{counted(steps, 'step')} of {counted(config['batch_size'], 'sample')}, "
        f"{counted(round(history.seconds / 60), 'minute')}, robots: "
        f"{', '.join(map(in_markdown, config['robots']))}.",
        "",
        "![curves](curves.png)",
        "",
        f"| step | {' | '.join(columns.values())} |",
        "|---" * (1 + len(columns)) + "|",
    ]
    for entry in history.validations:
        figures = " | ".join(f"{entry.get(name, math.nan):.4f}" for name in columns)
        lines.append(f"| {entry['step']} | {figures} |")
    lines += [
        "",
        "Validation images are made like the training images, from random numbers that training never sees.",
        "",
        "![example predictions](predictions.jpg)",
        "",
        "In predictions of masks, white is a true positive, black a true negative, orange a false positive and red a",
        "false negative. Parts are red (shaft), green (wrist) and blue (jaws).",
        "",
        "## Settings",
        "",
        "```json",
        json.dumps(config, indent=2).replace("`", "\\u0060"),
        "```",
        "",
    ]
    return "\n".join(lines)
