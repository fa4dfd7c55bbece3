"""Tables of the report.

The paper's tables on our data, speed, occluders, several cameras, calibrations, sequences and image-only networks.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product
from statistics import median
from typing import get_args

from ...html import Cell, Table
from ...wording import counted
from . import paper
from .conditions import OCCLUSION, SHARE
from .measurement import TOLERANCE, WIDE_TOLERANCE, Measurement, Score
from .rooms import Half
from .scope import BASELINES, METHODS, PAPERS_STEPS, RENDERING, SYNTHETIC
from .statistics import (
    DOMAIN_LABELS,
    GAINED,
    NOTHING,
    SHORT_LABELS,
    Measurements,
    Spread,
    begun,
    pairs,
    paper_note,
    scores,
    spread_text,
)
from .targets import NEAR_FINAL, steps_to_final

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
        for method, label in SHORT_LABELS.items():
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
                rows.append((Cell(label), Cell(DOMAIN_LABELS[domain]), *cells))
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
    for method, label in SHORT_LABELS.items():
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
            rows.append((Cell(label), Cell(DOMAIN_LABELS[domain]), *cells))
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


def speed_table(data: Measurements) -> Table:
    """Seconds per frame and how many frames each method made worse."""
    rows = []
    for source in data.sources():
        for method, entry in METHODS.items():
            # These have tables of their own: a frame's time is not the whole of it.
            if entry.together or entry.calibrated:
                continue
            chosen = data.of(source=source, method=method)
            if not chosen:
                continue
            steps = Spread.of(measurement.iterations for measurement in chosen)
            seconds = Spread.of(measurement.final.seconds for measurement in chosen)
            assert steps is not None and seconds is not None
            each = seconds.mean / steps.mean if steps.mean else None
            started = [measurement for measurement in chosen if measurement.start is not None]
            worse = Spread.of(float(measurement.made_worse) for measurement in started)
            rows.append(
                (
                    Cell(source),
                    Cell(entry.label),
                    Cell(str(len(chosen))),
                    Cell(f"{steps.mean:.1f}" if steps.mean else NOTHING),
                    Cell(f"{seconds.mean:.2f}"),
                    Cell(NOTHING if each is None else f"{1e3 * each:.0f}"),
                    Cell(NOTHING if worse is None or method == "start" else f"{100 * worse.mean:.1f} %"),
                )
            )
    return Table(
        "Seconds per frame, and frames made worse",
        "All runs of a method on the frames that all methods know, each frame alone, from the image's arrival to the "
        "result, without reading files. "
        "Made worse: Dice more than 0.01 below that of the start. The paper says that 30 to 50 iterations are far from "
        "video rate, and gives no seconds.",
        ("frames", "method", "runs", "iterations", "s per frame", "ms per iteration", "made worse"),
        tuple(rows),
    )


def pair_table(data: Measurements) -> Table | None:
    """The default solver against the paper's setting from the same starts; None where there are no pairs."""
    rows = []
    found = pairs(data)
    for source, error in dict.fromkeys((pair.source, pair.error_deg) for pair in found):
        chosen = [pair for pair in found if (pair.source, pair.error_deg) == (source, error) and pair.gained]
        steps = [steps_to_final(m) for m in data.of(source=source, method="ours", error_deg=error)]
        reached = [pair.ours for pair in chosen if pair.ours is not None]
        figures = (
            f"{median(pair.papers for pair in chosen):.2f}" if chosen else NOTHING,
            f"{median(reached):.2f}" if reached else NOTHING,
            f"{median(pair.ratio for pair in chosen):.1f}" if chosen else NOTHING,
            str(len(chosen) - len(reached)),
            f"{median(steps):g}",
        )
        rows.append(tuple(map(Cell, (source, begun(error), str(len(chosen)), *figures))))
    header = (
        *("frames", "error at the start", "pairs", "s, paper's setting", "s, ours", "times faster"),
        *("never there", f"steps to within {NEAR_FINAL}"),
    )
    caption = (
        f"Seconds until each has the Dice that the paper's setting ends with (its best of {PAPERS_STEPS}), median over "
        f"pairs of runs in which that setting gained at least {GAINED} Dice. A run of ours that never gets there "
        "counts as 0 times faster. Steps: median over all runs of ours until they are that near their final Dice."
    )
    return Table("Against the paper's setting, to equal Dice", caption, header, tuple(rows)) if rows else None


def worse_table(data: Measurements) -> Table | None:
    """The runs of the default solver that ended below their start; None where there are none."""
    worse = [measurement for measurement in data.default_solver() if measurement.made_worse]
    if not worse:
        return None
    return Table(
        "Frames made worse by the default solver",
        "Every one of them: where to look first.",
        ("frames", "domain", "frame", "method", "error at the start", "Dice at the start", "Dice"),
        tuple(_worse_row(measurement) for measurement in worse),
    )


def _worse_row(measurement: Measurement) -> tuple[Cell, ...]:
    run, start = measurement.run, measurement.start
    assert start is not None
    texts: Iterable[str] = (
        run.source,
        DOMAIN_LABELS[run.domain],
        str(run.frame),
        METHODS[run.method].label,
        begun(run.error_deg),
        f"{100 * start.dice:.1f}",
        f"{100 * measurement.final.dice:.1f}",
    )
    return tuple(map(Cell, texts))


def stage_table(stages: dict[str, float]) -> Table:
    """Milliseconds of each stage."""
    return Table(
        "Stages of one iteration",
        "Medians on the first frame of the shipped sequence (two arms, 640x480).",
        ("stage", "ms"),
        tuple((Cell(name), Cell(f"{value:.1f}")) for name, value in stages.items()),
    )


@dataclass(frozen=True)
class _Column:
    heading: str
    value: Callable[[Score], float | None]
    scale: float = 1.0
    digits: int = 2

    def cell(self, scores: Iterable[Score]) -> Cell:
        return Cell(spread_text(Spread.of(map(self.value, scores)), self.scale, self.digits))


_DICE = _Column("Dice", lambda score: score.dice, 100.0, 1)
_JOINTS = _Column("joint MAE [deg]", lambda score: score.joint_mae_deg)
_VISIBLE = _Column("visible joints [deg]", lambda score: score.visible_joint_mae_deg)
_TOGETHER = {"sequence": "ours", "temporal": "paper"}
"""Methods that correct frames together -> what they do with a frame alone."""
_DEPTH = _Column("depth of the tips [mm]", lambda score: score.tip_depth_mm)


def occlusion_table(data: Measurements) -> Table | None:
    """The default solver with nothing said of the occluders, with their pixels given, and with a proposal."""
    return _table(
        data,
        "Occluders before the instruments",
        f"Gauze, tissue or cloth over {100 * SHARE:.0f} % of the visible instruments. Dice of the rest, in percent: "
        "the occluders' pixels do not count, neither in the given mask nor in the estimate.",
        OCCLUSION,
        ("ours", "ours_given", "ours_proposed"),
        (_DICE, _JOINTS),
    )


def camera_table(data: Measurements) -> Table | None:
    """One camera against all of them in one objective."""
    return _table(
        data,
        "All cameras in one objective",
        "Dice of the first camera in percent. Depth: mean absolute error of the jaw tips along its axis. Posed: where "
        "the other cameras are is unknown, too, and expected near where the calibration has them.",
        "regular",
        ("ours", "stereo", "stereo_posed"),
        (_DICE, _JOINTS, _VISIBLE, _DEPTH),
    )


def calibration_table(data: Measurements) -> Table | None:
    """What one calibration of the whole recording does, alone and before the default solver."""
    return _table(
        data,
        "One calibration for all frames",
        "Base frames that are found once, from the images of the recording, joints as measured; then each frame is "
        "corrected from there. Dice in percent.",
        "regular",
        ("ours", "calibrated", "calibrated_ours"),
        (_DICE,),
    )


def sequence_table(data: Measurements) -> Table | None:
    """Frames corrected together, beside the same frames alone."""
    found = [m for method in _TOGETHER for m in data.of(method=method)]
    rows = []
    keys = dict.fromkeys((m.run.source, m.run.domain, m.run.error_deg) for m in found)
    for (source, domain, error), method in product(keys, _TOGETHER):
        together = data.of(source=source, domain=domain, method=method, error_deg=error)
        if not together:
            continue
        warm = [m.final.seconds for m in together if m.stopped == "warm"]
        alone_method = _TOGETHER[method]
        alone = {m.run.frame: m for m in data.of(source=source, domain=domain, method=alone_method, error_deg=error)}
        both = [m for m in together if m.run.frame in alone]
        rows.append(
            (
                Cell(source),
                Cell(DOMAIN_LABELS[domain]),
                Cell(begun(error)),
                Cell(METHODS[method].label),
                Cell(str(len(together))),
                *(
                    Cell(
                        column.cell(m.final for m in together).text,
                        f"before: {column.cell(m.start for m in together if m.start).text}",
                    )
                    for column in (_DICE, _JOINTS)
                ),
                _VISIBLE.cell(m.final for m in together),
                Cell(f"{median(warm):.2f}" if warm else NOTHING, counted(len(warm), "frame")),
                Cell(str(len(both))),
                _DICE.cell(alone[m.run.frame].final for m in both),
                _DICE.cell(m.final for m in both),
            )
        )
    header = (
        *(
            "frames",
            "domain",
            "error at the start",
            "method",
            "number",
            "Dice",
            "joint MAE [deg]",
            "visible joints [deg]",
        ),
        *("s per warm frame", "also alone", "Dice alone", "Dice together"),
    )
    caption = (
        "The first frames of each sequence, one knowing what the others found. An error at the start is the same in "
        "all of them; alone, each frame has signs of its own. Seconds: "
        "median over frames that started at their neighbour's correction, reading the image included. At the right the "
        "frames that were corrected alone, too. TC-CaRTS is the first of its three modules here: each frame starts "
        "at the previous correction and takes ten steps of ACS; the other two are not described well enough. Beside "
        "it, alone means the paper's setting."
    )
    return Table("Frames corrected together", caption, header, tuple(rows)) if rows else None


def room_table(data: Measurements) -> Table | None:
    """Instruments in other rooms: the default solver, each frame alone and in a sequence, beside ACS."""
    rows = []
    for camera, half in product(data.room_cameras(), get_args(Half)):
        alone, acs, together = (data.in_rooms(camera, half, method) for method in ("ours", "acs", "sequence"))
        if not alone:
            continue
        starts = [m.start for m in alone if m.start]
        worse, sequence = (sum(m.made_worse for m in found) for found in (alone, together))
        rows.append(
            (
                *map(Cell, (camera, half, str(len({m.run.domain for m in alone})))),
                _DICE.cell(starts),
                Cell(_DICE.cell(m.final for m in alone).text, f"made worse: {worse} of {len(alone)}"),
                _DICE.cell(m.final for m in acs),
                Cell(_DICE.cell(m.final for m in together).text, f"made worse: {sequence} of {len(together)}"),
            )
        )
    header = ("camera", "rooms", "number", "Dice before", "ours", "ACS, our schedule", "ours, sequence mode")
    caption = (
        "Instruments, cut out by their masks and put before made rooms and photographs, started at the measured "
        "kinematics; real ones by camera, and those of the synthetic frames. Nothing was chosen on rooms that are held "
        "out. Dice in percent; made worse: by more than 1."
    )
    return Table("Instruments in other rooms", caption, header, tuple(rows)) if rows else None


def _table(
    data: Measurements, title: str, caption: str, domain: str, methods: tuple[str, ...], columns: tuple[_Column, ...]
) -> Table | None:
    """A row per source, error at the start and method, over frames that all methods have; None where there are none."""
    rows = []
    for source in data.sources():
        for error in _errors(data.of(source=source, domain=domain, method=methods[-1])):
            runs = {
                name: {m.run.frame: m for m in data.of(source=source, domain=domain, method=name, error_deg=error)}
                for name in methods
            }
            frames = sorted(set.intersection(*(set(found) for found in runs.values())))
            if not frames:
                continue
            starts = [start for frame in frames if (start := runs["ours"][frame].start)]
            results = [(METHODS[name].label, [found[frame].final for frame in frames]) for name, found in runs.items()]
            for label, found_scores in [("not corrected", starts), *results]:
                cells = (column.cell(found_scores) for column in columns)
                rows.append((Cell(source), Cell(str(len(frames))), Cell(begun(error)), Cell(label), *cells))
    header = ("frames", "number", "error at the start", "method", *(column.heading for column in columns))
    return Table(title, caption, header, tuple(rows)) if rows else None


def _errors(measurements: Iterable[Measurement]) -> list[float | None]:
    found = {measurement.run.error_deg for measurement in measurements}
    return sorted(found, key=lambda error: -1.0 if error is None else error)
