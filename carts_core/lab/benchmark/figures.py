"""The report's plots, as SVG files."""

from collections.abc import Callable, Iterable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from ...files import OutputPath, output_stream
from ...wording import counted
from . import paper
from .accuracy_tables import ROWS
from .measurement import Measurement, Score
from .scope import SYNTHETIC
from .statistics import Measurements, Spread, scores
from .tables import DOMAIN_LABELS, SHORT_LABELS

matplotlib.use("Agg")
# Same measurements, same bytes.
matplotlib.rcParams["svg.hashsalt"] = "carts"

COLORS = {"paper": "#b3541e", "ours": "#1f5fa8"}
_BARS = ("#9aa0a6", "#d0d3d6", "#c9a227", "#e0905c", "#b3541e", "#1f5fa8")


def write_figures(data: Measurements, folder: OutputPath) -> dict[str, Path]:
    """Draw every plot that the measurements allow; returns its caption -> its file."""
    made: dict[str, Path] = {}
    for name, caption, draw in (
        ("domains", "Dice by method and domain, from the measured kinematics. Lines: standard deviation.", _domains),
        (
            "convergence",
            "Convergence on the synthetic frames, from the measured kinematics: best iterate so far, mean and "
            "quartiles over frames of all domains. A run that has ended keeps its value. Losses are of runs in which "
            "they fell; ours compare within one observation only and are left out.",
            _convergence,
        ),
        ("errors", "Dice and joint error after optimization, by the error at the start (regular domain).", _errors),
        (
            "scatter",
            "Dice and joint error after optimization against the Dice at the start: one point per run, all errors at "
            "the start. Below the dashed line a frame was made worse.",
            _scatter,
        ),
    ):
        figure = draw(data)
        if figure is not None:
            path = folder / f"{name}.svg"
            with output_stream(path) as stream:
                figure.savefig(stream, format="svg", metadata={"Date": None})
            made[caption] = path.path
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
            spreads = [
                Spread.of(
                    score.dice
                    for score in scores(data.of(source=source, domain=d, method=method, error_deg=None), steps)
                )
                for d in domains
            ]
            places = [index + 0.13 * (number - 2.5) for index, spread in enumerate(spreads) if spread]
            known = [spread for spread in spreads if spread]
            axes.bar(places, [s.mean for s in known], 0.12, color=_BARS[number], label=label)
            axes.errorbar(places, [s.mean for s in known], [s.deviation for s in known], fmt="none", color="#333", lw=1)
            lowest = min([lowest, *(s.mean - s.deviation for s in known)])
        axes.set_xticks(range(len(domains)), [DOMAIN_LABELS[domain] for domain in domains])
        axes.set(title=f"{source} frames", ylabel="Dice", ylim=(max(0.0, np.floor(10 * lowest - 0.5) / 10), 1.0))
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
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
        title="loss by iteration, where it fell", xlabel="iteration", ylabel="share of the loss's fall still to come"
    )
    _finish(figure.axes)
    return figure


def _falls(measurement: Measurement) -> bool:
    """Whether the losses of a run compare and one is below the first."""
    best = measurement.best_so_far()
    return all(score.loss is not None for score in measurement.trace) and best[-1].loss != best[0].loss


def _loss_to_go(measurement: Measurement) -> list[float]:
    """The methods' losses are not in one unit, so each is scaled to fall from 1 to 0."""
    losses = [score.loss or 0.0 for score in measurement.best_so_far()]
    return [(loss - losses[-1]) / (losses[0] - losses[-1]) for loss in losses]


def _padded(measurements: list[Measurement], steps: int, values: Callable[[Measurement], list[float]]) -> np.ndarray:
    """[runs, steps + 1]; runs that ended earlier keep their last value."""
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
    for axes, value, table, scale in (
        (dice_axes, _dice, paper.DICE_BY_ERROR, 0.01),
        (mae_axes, _mae, paper.MAE_BY_ERROR, 1.0),
    ):
        for method, color in COLORS.items():
            runs = data.of(source=SYNTHETIC, domain="regular", method=method)
            degrees = sorted({m.run.error_deg for m in runs if m.run.error_deg is not None})
            spreads = [Spread.of(value(m.final) for m in runs if m.run.error_deg == error) for error in degrees]
            known = [(error, spread) for error, spread in zip(degrees, spreads, strict=True) if spread]
            _with_bars(axes, [(e, s.mean, s.deviation) for e, s in known], color, "o-", SHORT_LABELS[method])
        points = [(error, scale * mean, scale * deviation) for error, (mean, deviation) in table["S-Reg"].items()]
        _with_bars(axes, points, "#777", "x--", "paper's own numbers (S-Reg)")
    dice_axes.set(title="Dice", xlabel="error of every joint at the start [deg]", ylabel="Dice")
    mae_axes.set(title="joint MAE", xlabel="error of every joint at the start [deg]", ylabel="MAE [deg]")
    mae_axes.axline((0, 0), slope=1, color="#bbb", lw=1, ls=":", label="no change")
    _finish(figure.axes)
    return figure


def _with_bars(axes: Axes, points: list[tuple[float, float, float]], color: str, style: str, label: str) -> None:
    if points:
        x, mean, deviation = zip(*points, strict=True)
        axes.errorbar(x, mean, deviation, fmt=style, color=color, label=label, capsize=2, ms=4, lw=1.2)


def _scatter(data: Measurements) -> Figure | None:
    panels = [
        (source, name, value)
        for source in data.sources()
        for name, value in (("Dice", _dice), ("joint MAE [deg]", _mae))
        if any(m.start is not None and value(m.final) is not None for m in data.of(source=source))
    ]
    if not panels:
        return None
    columns = 2
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(9, 3.7 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, (source, name, value) in zip(grid, panels, strict=False):
        for method, color in COLORS.items():
            known = [m for m in data.of(source=source, method=method) if m.start and value(m.final) is not None]
            x, y = [m.start.dice for m in known if m.start], [value(m.final) for m in known]
            axes.scatter(x, y, s=12, color=color, alpha=0.6, label=SHORT_LABELS[method], lw=0)
        if name == "Dice":
            limits = axes.get_xlim(), axes.get_ylim()
            axes.axline((0.9, 0.89), slope=1, color="#999", lw=1, ls="--")
            axes.set(xlim=limits[0], ylim=limits[1])
        axes.set(title=f"{source} frames", xlabel="Dice at the start", ylabel=f"{name} after")
    _finish(grid[: len(panels)])
    return figure


def _finish(axes_of_figure: Iterable[Axes]) -> None:
    for axes in axes_of_figure:
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)


def _dice(score: Score) -> float | None:
    return score.dice


def _mae(score: Score) -> float | None:
    return score.joint_mae_deg
