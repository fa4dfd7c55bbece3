"""How long methods take, stage by stage, and which frames they made worse."""

from collections.abc import Iterable

from .measurement import Measurement
from .methods import METHODS
from .statistics import Measurements, Spread
from .tables import DOMAIN_LABELS, NOTHING, Cell, Table


def speed_table(data: Measurements) -> Table:
    """Seconds per frame and how many frames each method made worse."""
    rows = []
    for source in data.sources():
        for method, entry in METHODS.items():
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
                    Cell(f"{steps.mean:.1f}"),
                    Cell(f"{seconds.mean:.2f}"),
                    Cell(NOTHING if each is None else f"{1e3 * each:.0f}"),
                    Cell(NOTHING if worse is None or method == "start" else f"{100 * worse.mean:.1f} %"),
                )
            )
    return Table(
        "Seconds per frame, and frames made worse",
        "Over all runs of a method, each frame alone, from the image's arrival to the result, without reading files. "
        "Made worse: Dice more than 0.01 below that of the start. The paper says that 30 to 50 iterations are far from "
        "video rate, and gives no seconds.",
        ("frames", "method", "runs", "iterations", "s per frame", "ms per iteration", "made worse"),
        tuple(rows),
    )


def worse_table(data: Measurements) -> Table | None:
    """The runs of the default solver that ended below their start; None where there are none."""
    worse = [measurement for measurement in data.of(method="ours") if measurement.made_worse]
    if not worse:
        return None
    return Table(
        "Frames made worse by the default solver",
        "Every one of them: where to look first.",
        ("frames", "domain", "frame", "error at the start", "Dice at the start", "Dice"),
        tuple(_worse_row(measurement) for measurement in worse),
    )


def _worse_row(measurement: Measurement) -> tuple[Cell, ...]:
    run, start = measurement.run, measurement.start
    assert start is not None
    error = "as measured" if run.error_deg is None else f"{run.error_deg:g}°"
    texts: Iterable[str] = (
        run.source,
        DOMAIN_LABELS[run.domain],
        str(run.frame),
        error,
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
