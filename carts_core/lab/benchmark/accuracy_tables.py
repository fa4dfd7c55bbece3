"""The paper's tables on our data, its numbers beside ours: methods, iterations, error at the start."""

from collections.abc import Callable

from ...html import Cell, Table
from . import paper
from .frame import TOLERANCE, WIDE_TOLERANCE
from .measurement import Score
from .methods import BASELINES, METHODS, RENDERING
from .scope import SYNTHETIC
from .statistics import Measurements, Spread, scores
from .tables import DOMAIN_LABELS, NOTHING, SHORT_LABELS, paper_note, spread_text

ROWS = (
    ("U-Net alone", "unet", None),
    ("CaRTS without optimization", "start", None),
    ("CaRTS L1, best of 50", "l1", 50),
    ("CaRTS ACS, paper's setting, best of 30", "paper", 30),
    ("CaRTS ACS, paper's setting, best of 50", "paper", 50),
    ("CaRTS, ours", "ours", None),
)
"""Label, method and number of steps of the main table's rows."""


def baseline_rows(data: Measurements) -> tuple[tuple[str, str, None], ...]:
    """The same of networks of others, and of the surface network alone, where they were measured."""
    known = {measurement.run.method for measurement in data.all}
    return tuple((METHODS[name].label, name, None) for name in (*BASELINES, RENDERING) if name in known)


def main_tables(data: Measurements) -> list[Table]:
    """Dice and NSD of every method in every domain, from the measured joint positions."""
    figures = (
        ("Dice", _dice, None),
        (f"NSD at {TOLERANCE:g} px", _nsd, TOLERANCE),
        (f"NSD at {WIDE_TOLERANCE:g} px", _wide, WIDE_TOLERANCE),
    )
    tables = []
    for source in data.sources():
        domains = data.domains(source)
        for name, value, tolerance in figures:
            rows = tuple(
                (Cell(label), *(_main_cell(data, source, domain, method, steps, value) for domain in domains))
                for label, method, steps in (*baseline_rows(data), *ROWS)
            )
            caption = f"{name} in percent, mean ± standard deviation over frames, started at the measured kinematics."
            if tolerance is not None:
                caption += f" Normalized surface distance within {tolerance:g} px; the paper does not give it."
            header = ("method", *(DOMAIN_LABELS[domain] for domain in domains))
            tables.append(Table(f"{source.capitalize()} frames: {name}", caption, header, rows))
    return tables


def _main_cell(
    data: Measurements,
    source: str,
    domain: str,
    method: str,
    steps: int | None,
    value: Callable[[Score], float | None],
) -> Cell:
    chosen = data.of(source=source, domain=domain, method=method, error_deg=None)
    text = spread_text(Spread.of(value(score) for score in scores(chosen, steps)))
    if value is not _dice or steps == 30:
        return Cell(text)
    column = paper.COLUMNS.get((source, domain))
    return Cell(text, paper_note(paper.DICE.get(method, {}).get(column or ""), column))


def iteration_tables(data: Measurements) -> list[Table]:
    """Dice of the best iterate of the first so many steps."""
    tables = []
    for source in data.sources():
        rows = []
        for method in SHORT_LABELS:
            for domain in data.domains(source):
                chosen = data.of(source=source, domain=domain, method=method, error_deg=None)
                column = paper.COLUMNS.get((source, domain)) if method == "paper" else None
                theirs = paper.DICE_BY_ITERATIONS.get(column or "", (None,) * len(paper.ITERATIONS))
                cells = (
                    Cell(
                        spread_text(Spread.of(map(_dice, scores(chosen, steps)))),
                        paper_note(value, column),
                    )
                    for steps, value in zip(paper.ITERATIONS, theirs, strict=True)
                )
                rows.append((Cell(SHORT_LABELS[method]), Cell(DOMAIN_LABELS[domain]), *cells))
        tables.append(
            Table(
                f"{source.capitalize()} frames: Dice by iterations",
                "Best iterate (lowest loss) of the first so many steps of one run, in percent, started at the measured "
                f"kinematics. {NOTHING}: the setting ends before. A run that has converged keeps its value.",
                ("method", "domain", *map(str, paper.ITERATIONS)),
                tuple(rows),
            )
        )
    return tables


def error_tables(data: Measurements) -> list[Table]:
    """Dice and joint MAE by the size of the error at the start."""
    tables = []
    for source in data.sources():
        errors = sorted({run.run.error_deg for run in data.of(source=source) if run.run.error_deg is not None})
        if not errors:
            continue
        for name, value, scale in (
            ("Dice", _dice, 100.0),
            ("joint MAE", lambda score: score.joint_mae_deg, 1.0),
            ("joint MAE, visible joints", lambda score: score.visible_joint_mae_deg, 1.0),
        ):
            if rows := _error_rows(data, source, errors, name, value, scale):
                tables.append(
                    Table(
                        f"{source.capitalize()} frames: {name} by the error at the start",
                        _error_caption(source, name),
                        ("method", "domain", *(f"{error:g}°" for error in errors)),
                        tuple(rows),
                    )
                )
    return tables


def _error_rows(
    data: Measurements,
    source: str,
    errors: list[float],
    name: str,
    value: Callable[[Score], float | None],
    scale: float,
) -> list[tuple[Cell, ...]]:
    rows = []
    for method in SHORT_LABELS:
        for domain in data.domains(source):
            spreads = [
                Spread.of(map(value, scores(data.of(source=source, domain=domain, method=method, error_deg=error))))
                for error in errors
            ]
            if not any(spreads):
                continue
            column = paper.COLUMNS.get((source, domain)) if method == "paper" else None
            theirs = (paper.DICE_BY_ERROR if name == "Dice" else paper.MAE_BY_ERROR).get(column or "", {})
            digits = 1 if name == "Dice" else 2
            cells = (
                Cell(spread_text(spread, scale, digits), paper_note(theirs.get(error), column))
                for error, spread in zip(errors, spreads, strict=True)
            )
            rows.append((Cell(SHORT_LABELS[method]), Cell(DOMAIN_LABELS[domain]), *cells))
    return rows


def _error_caption(source: str, name: str) -> str:
    origin = "the true" if source == SYNTHETIC else "the measured (the truth is not known)"
    unit = "Dice in percent" if name == "Dice" else "Mean absolute error of measured revolute joints [deg]"
    return (
        f"{unit}, mean ± standard deviation. Every joint starts that many degrees (insertion: millimetres) off "
        f"{origin} joint positions, each with a random sign."
    )


def _dice(score: Score) -> float:
    return score.dice


def _nsd(score: Score) -> float:
    return score.nsd


def _wide(score: Score) -> float | None:
    return score.nsd_wide
