"""Benchmark report: one HTML page, plots as SVG, and the same numbers as JSON and CSV."""

import csv
import io
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ...files import OutputPath, csv_cell, output_stream, write_text
from ...html import render_page
from ...wording import counted
from .hand_eye import HandEyeRun, hand_eye_targets
from .measurement import BEST_OF, TOLERANCE, Measurement
from .scope import SYNTHETIC
from .statistics import DICE, DOMAIN_LABELS, JOINT_MAE, PAPER, SHORT_LABELS, TEXTS, Measurements, scores
from .tables import ROWS
from .tables import sections as sections_of
from .targets import targets

matplotlib.use("Agg")
# This setting makes the SVG files reproducible.
matplotlib.rcParams["svg.hashsalt"] = "carts"

COLORS = {"paper": "#b3541e", "ours": "#1f5fa8"}
_PAPERS_TABLES = ("dice", "dice_by_iterations", "dice_by_error", "mae_by_error")
_BARS = ("#9aa0a6", "#d0d3d6", "#c9a227", "#e0905c", "#b3541e", "#1f5fa8", "#7fb2e5")


def write_figures(data: Measurements, folder: OutputPath) -> dict[str, Path]:
    """Draw all plots that have measurements; returns caption -> file."""
    made: dict[str, Path] = {}
    for name, draw in {
        "domains": _domains,
        "convergence": _convergence,
        "errors": _errors,
        "scatter": _scatter,
    }.items():
        if (figure := draw(data)) is not None:
            path = folder / f"{name}.svg"
            with output_stream(path) as stream:
                figure.savefig(stream, format="svg", metadata={"Date": None})
            made[TEXTS["figures"][name]] = path.path
    return made


def _domains(data: Measurements) -> Figure | None:
    sources = data.sources()
    if not sources:
        return None
    figure = Figure(figsize=(11, 3.1 * len(sources)), layout="constrained")
    for axes, source in zip(figure.subplots(len(sources), 1, squeeze=False)[:, 0], sources, strict=True):
        domains = data.domains(source)
        lowest = 1.0
        for number, (label, method, steps) in enumerate(ROWS):
            found = {
                index + 0.12 * (number - 3): np.array([score.dice for score in chosen])
                for index, domain in enumerate(domains)
                if (chosen := scores(data.of(source=source, domain=domain, method=method, error_deg=None), steps))
            }
            means, deviations = [dice.mean() for dice in found.values()], [dice.std() for dice in found.values()]
            axes.bar(list(found), means, 0.11, color=_BARS[number], label=label)
            axes.errorbar(list(found), means, deviations, fmt="none", color="#333", lw=1)
            lowest = min([lowest, *(mean - deviation for mean, deviation in zip(means, deviations, strict=True))])
        axes.set_xticks(range(len(domains)), [DOMAIN_LABELS[domain] for domain in domains])
        axes.set(title=f"{source} frames", ylabel="Dice", ylim=(max(0.0, np.floor(10 * lowest - 0.5) / 10), 1.0))
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def _convergence(data: Measurements) -> Figure | None:
    chosen = {method: data.of(source=SYNTHETIC, method=method, error_deg=None) for method in COLORS}
    if not any(chosen.values()):
        return None
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    by_step, by_time, loss = figure.subplots(1, 3)
    for method, measurements in chosen.items():
        if not measurements:
            continue
        steps = max(m.iterations for m in measurements)
        dice = _padded(measurements, steps, lambda m: [score.dice for score in m.best_so_far()])
        _band(by_step, np.arange(steps + 1), dice, method)
        falling = [m for m in measurements if _falls(m)]
        if falling:
            label = f"{SHORT_LABELS[method]}: {len(falling)} of {counted(len(measurements), 'run')}"
            _band(loss, np.arange(steps + 1), _padded(falling, steps, _loss_to_go), method, label)
        seconds = _padded(measurements, steps, lambda m: [score.seconds for score in m.trace])
        _band(by_time, np.median(seconds, axis=0), dice, method)
    by_step.set(title="Dice by iteration", xlabel="iteration", ylabel="Dice")
    by_time.set(title="Dice by time", xlabel="seconds (log)", ylabel="Dice", xscale="log")
    by_time.xaxis.set_major_formatter("{x:g}")
    by_time.xaxis.set_minor_formatter(NullFormatter())
    loss.set(
        title="loss by iteration, runs with a decreasing loss",
        xlabel="iteration",
        ylabel=("remaining share of the loss decrease"),
    )
    _finish(figure.axes)
    return figure


def _falls(measurement: Measurement) -> bool:
    """Whether the losses of a run are comparable and decrease."""
    best = measurement.best_so_far()
    return all(score.loss is not None for score in measurement.trace) and best[-1].loss != best[0].loss


def _loss_to_go(measurement: Measurement) -> list[float]:
    """Losses scaled to the range from 1 (first) to 0 (lowest), since the units of losses differ between methods."""
    losses = [score.loss or 0.0 for score in measurement.best_so_far()]
    return [(loss - losses[-1]) / (losses[0] - losses[-1]) for loss in losses]


def _padded(measurements: list[Measurement], steps: int, values: Callable[[Measurement], list[float]]) -> np.ndarray:
    """Values as an array [runs, steps + 1]; the last value of shorter runs is repeated."""
    rows = [values(measurement) for measurement in measurements]
    return np.array([row + [row[-1]] * (steps + 1 - len(row)) for row in rows])


def _band(axes: Axes, x: np.ndarray, values: np.ndarray, method: str, label: str | None = None) -> None:
    axes.plot(x, values.mean(0), color=COLORS[method], label=label or SHORT_LABELS[method])
    axes.fill_between(x, *np.quantile(values, (0.25, 0.75), axis=0), color=COLORS[method], alpha=0.15, lw=0)


def _errors(data: Measurements) -> Figure | None:
    if not any(m.run.error_deg is not None for m in data.of(source=SYNTHETIC)):
        return None
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    dice_axes, mae_axes = figure.subplots(1, 2)
    for axes, figure_of, table, scale in (
        (dice_axes, DICE, "dice_by_error", 0.01),
        (mae_axes, JOINT_MAE, "mae_by_error", 1.0),
    ):
        for method, color in COLORS.items():
            runs = data.of(source=SYNTHETIC, domain="regular", method=method)
            degrees = sorted({m.run.error_deg for m in runs if m.run.error_deg is not None})
            found = {error: figure_of.values(m.final for m in runs if m.run.error_deg == error) for error in degrees}
            known = [(e, float(np.mean(values)), float(np.std(values))) for e, values in found.items() if values]
            _with_bars(axes, known, color, "o-", SHORT_LABELS[method])
        points = [(float(error), scale * mean, scale * std) for error, (mean, std) in PAPER[table]["S-Reg"].items()]
        _with_bars(axes, points, "#777", "x--", "numbers of the paper (S-Reg)")
    dice_axes.set(title="Dice", xlabel="initial error of every joint [deg]", ylabel="Dice")
    mae_axes.set(title="joint MAE", xlabel="initial error of every joint [deg]", ylabel="MAE [deg]")
    mae_axes.axline((0, 0), slope=1, color="#bbb", lw=1, ls=":", label="no change")
    _finish(figure.axes)
    return figure


def _with_bars(axes: Axes, points: list[tuple[float, float, float]], color: str, style: str, label: str) -> None:
    if points:
        x, mean, deviation = zip(*points, strict=True)
        axes.errorbar(x, mean, deviation, fmt=style, color=color, label=label, capsize=2, ms=4, lw=1.2)


def _scatter(data: Measurements) -> Figure | None:
    panels = [
        (source, value)
        for source in data.sources()
        for value in (DICE, JOINT_MAE)
        if value.values(m.final for m in data.of(source=source) if m.start)
    ]
    if not panels:
        return None
    columns = 2
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(9, 3.7 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, (source, value) in zip(grid, panels, strict=False):
        for method, color in COLORS.items():
            runs = data.of(source=source, method=method)
            known = [m for m in runs if m.start and value.values([m.final])]
            x, y = DICE.values(m.start for m in known), value.values(m.final for m in known)
            axes.scatter(x, y, s=12, color=color, alpha=0.6, label=SHORT_LABELS[method], lw=0)
        if value is DICE:
            limits = axes.get_xlim(), axes.get_ylim()
            axes.axline((0.9, 0.89), slope=1, color="#999", lw=1, ls="--")
            axes.set(xlim=limits[0], ylim=limits[1])
        axes.set(title=f"{source} frames", xlabel="initial Dice", ylabel=f"{value.heading} after")
    _finish(grid[: len(panels)])
    return figure


def _finish(axes_of_figure: Iterable[Axes]) -> None:
    for axes in axes_of_figure:
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)


@dataclass(frozen=True)
class Facts:
    """Provenance of the report."""

    scope: str
    """`quick` or `full`."""
    planned: int
    """Number of planned runs, including runs that are not yet measured."""
    sources: dict[str, str]
    """Name -> description."""
    weights: str
    """SHA-256 of the network's weights."""
    code: str
    """SHA-256 of the measured code."""
    version: str


def write_report(
    folder: OutputPath,
    measurements: list[Measurement],
    facts: Facts,
    stages: dict[str, float],
    hand_eye: list[HandEyeRun],
) -> Path:
    """Write `report.html`, `figures/`, `results.json` and `results.csv`; returns the page's path.

    `stages` maps stages of an iteration to milliseconds, and `hand_eye` contains calibrations of another robot; both
    may be empty.

    Raises:
        CartsError: the folder cannot be written to.
    """
    data = Measurements(measurements)
    verdicts = [*targets(data), *hand_eye_targets(hand_eye)]
    sections = sections_of(data, stages, hand_eye)
    figures = write_figures(data.compared(), folder / "figures")
    rows = [_row(measurement) for measurement in measurements]
    machines = sorted({measurement.machine for measurement in measurements})
    warnings = {
        "The benchmark is incomplete; rerun the command to resume.": len(rows) < facts.planned,
        "Runs used different machines or numbers of threads, so their times are not comparable.": len(machines) > 1,
    }
    document = {
        "format": "carts-benchmark/1",
        "facts": asdict(facts),
        "measured": len(measurements),
        "machines": machines,
        "targets": [asdict(target) for target in verdicts],
        "tables": [asdict(table) for tables in sections.values() for table in tables],
        "stages_ms": stages,
        "hand_eye": [asdict(run) for run in hand_eye],
        "paper": {name: PAPER[name] for name in ("source", *_PAPERS_TABLES)},
        "runs": rows,
    }
    write_text(folder / "results.json", json.dumps(document, indent=1))
    write_text(folder / "results.csv", _csv(rows))
    page = render_page(
        "benchmark.html",
        title="CaRTS benchmark",
        facts={
            "runs": f"{len(measurements)} of {facts.planned} measured ({facts.scope})",
            **{f"{name} frames": description for name, description in facts.sources.items()},
            "machine": "; ".join(machines) or "-",
            "carts": f"{facts.version}, measured code {facts.code[:12]}",
            "weights": facts.weights[:12],
        },
        warnings=[text for text, holds in warnings.items() if holds],
        targets=verdicts,
        figures={caption: path.relative_to(folder.path).as_posix() for caption, path in figures.items()},
        sections=sections,
        tolerance=f"{TOLERANCE:g}",
        source=PAPER["source"],
    )
    path = folder / "report.html"
    write_text(path, page)
    return path.path


def _row(measurement: Measurement) -> dict[str, object]:
    """CSV row of a run."""
    start, final = measurement.start, measurement.final
    bests = {steps: measurement.best_of(steps) for steps in BEST_OF}
    return {
        **asdict(measurement.run),
        "dice_start": start and start.dice,
        "dice": final.dice,
        **{f"dice_best_of_{steps}": best and best.dice for steps, best in bests.items()},
        "nsd_start": start and start.nsd,
        "nsd": final.nsd,
        "nsd_wide": final.nsd_wide,
        "joint_mae_deg_start": start and start.joint_mae_deg,
        "joint_mae_deg": final.joint_mae_deg,
        "visible_joint_mae_deg": final.visible_joint_mae_deg,
        "tip_depth_mm": final.tip_depth_mm,
        "iterations": measurement.iterations,
        "seconds": final.seconds,
        "made_worse": measurement.made_worse,
        "verdict": measurement.verdict,
        "probability_of_failure": measurement.probability,
        "stopped": measurement.stopped,
    }


def _csv(rows: list[dict[str, object]]) -> str:
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {name: csv_cell(cell) if isinstance(cell, str) else cell for name, cell in row.items()} for row in rows
        )
    return text.getvalue()
