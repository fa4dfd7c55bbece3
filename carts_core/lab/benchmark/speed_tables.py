"""How long methods take, stage by stage, and which frames they made worse."""

from collections.abc import Iterable
from statistics import median

from ...html import Cell, Table
from .measurement import Measurement
from .methods import METHODS
from .pairing import GAINED, pairs
from .scope import PAPERS_STEPS
from .speed_targets import NEAR_FINAL, steps_to_final
from .statistics import Measurements, Spread
from .tables import DOMAIN_LABELS, NOTHING, begun


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
