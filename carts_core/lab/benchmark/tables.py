"""Tables of the report; each row is a dict heading -> text."""

from collections.abc import Sequence
from itertools import product
from statistics import mean, median
from typing import get_args

from ...html import Cell, Table
from ...settings import DOMAINS
from ...wording import counted
from .conditions import OCCLUSION, SHARE
from .hand_eye import HandEyeRun, hand_eye_table
from .measurement import Measurement
from .rooms import Half
from .scope import BASELINES, FAMILY, METHODS, PAPERS_STEPS, RENDERING, ROOMS, SYNTHETIC
from .statistics import (
    DICE,
    DOMAIN_LABELS,
    JOINT_MAE,
    MIN_GAIN,
    NO_VALUE,
    NSD,
    PAPER,
    SHORT_LABELS,
    TIP_DEPTH,
    VISIBLE_MAE,
    WIDE_NSD,
    Figure,
    Measurements,
    pairs,
    paper_column,
    scores,
    start_label,
    table_of,
)
from .targets import (
    MIN_CORRECT_DICE,
    NEAR_FINAL,
    good_verdicts,
    image_alone,
    roc_area,
    steps_to_final,
    with_verdict,
    within,
    wrong_masks,
)

Row = dict[str, str | Cell]

ROWS = (
    ("U-Net alone", "unet", None),
    ("CaRTS without optimization", "start", None),
    ("CaRTS L1, best of 50", "l1", 50),
    ("CaRTS ACS, paper's setting, best of 30", "paper", 30),
    ("CaRTS ACS, paper's setting, best of 50", "paper", 50),
    ("CaRTS, ours", "ours", None),
    ("CaRTS, ours, refined masks", "ours_refined", None),
)
"""Label, method and number of steps of the main table's rows."""


def main_tables(data: Measurements) -> list[Table]:
    """Dice and NSD of every method in every domain, from the measured joint positions."""
    known = {measurement.run.method for measurement in data.all}
    baselines = [(METHODS[name].label, name, None) for name in (*BASELINES, RENDERING) if name in known]
    tables = []
    for source, figure in product(data.sources(), (DICE, NSD, WIDE_NSD)):
        rows = []
        for label, method, steps in (*baselines, *ROWS):
            row: Row = {"method": label}
            for domain in data.domains(source):
                chosen = scores(data.of(source=source, domain=domain, method=method, error_deg=None), steps)
                column = paper_column(source, domain) if figure is DICE and steps != 30 else ""
                row[DOMAIN_LABELS[domain]] = figure.cell(chosen, PAPER["dice"].get(method, {}).get(column), column)
            rows.append(row)
        name = "main" if figure is DICE else "main_nsd"
        tables.append(table_of(name, rows, source=source.capitalize(), figure=figure.heading))
    return [table for table in tables if table]


def iteration_tables(data: Measurements) -> list[Table]:
    """Dice of the best iterate by number of steps."""
    tables = []
    for source in data.sources():
        rows = []
        for (method, label), domain in product(SHORT_LABELS.items(), data.domains(source)):
            chosen = data.of(source=source, domain=domain, method=method, error_deg=None)
            column = paper_column(source, domain) if method == "paper" else ""
            theirs = PAPER["dice_by_iterations"].get(column, [None] * len(PAPER["iterations"]))
            cells = {
                str(steps): DICE.cell(scores(chosen, steps), value, column)
                for steps, value in zip(PAPER["iterations"], theirs, strict=True)
            }
            rows.append({"method": label, "domain": DOMAIN_LABELS[domain], **cells})
        tables.append(table_of("iterations", rows, source=source.capitalize()))
    return [table for table in tables if table]


def error_tables(data: Measurements) -> list[Table]:
    """Dice and joint MAE by initial error."""
    tables = []
    for source in data.sources():
        errors = sorted({run.run.error_deg for run in data.of(source=source) if run.run.error_deg is not None})
        origin = "the true" if source == SYNTHETIC else "the measured values (ground truth is unknown)"
        mae = "Mean absolute error of measured revolute joints [deg]"
        for figure, name, unit, theirs in (
            (DICE, "Dice", "Dice in percent", "dice_by_error"),
            (JOINT_MAE, "joint MAE", mae, "mae_by_error"),
            (VISIBLE_MAE, "joint MAE, visible joints", mae, "mae_by_error"),
        ):
            rows = []
            for (method, label), domain in product(SHORT_LABELS.items(), data.domains(source)):
                found = {
                    error: scores(data.of(source=source, domain=domain, method=method, error_deg=error))
                    for error in errors
                }
                column = paper_column(source, domain) if method == "paper" else ""
                numbers = PAPER[theirs].get(column, {})
                if any(figure.values(chosen) for chosen in found.values()):
                    cells = {
                        f"{error:g}°": figure.cell(chosen, numbers.get(f"{error:g}"), column)
                        for error, chosen in found.items()
                    }
                    rows.append({"method": label, "domain": DOMAIN_LABELS[domain], **cells})
            texts = {"source": source.capitalize(), "name": name, "unit": unit, "origin": origin}
            tables.append(table_of("errors", rows, **texts))
    return [table for table in tables if table]


def speed_table(data: Measurements) -> Table | None:
    """Seconds per frame, and number of frames made worse by each method."""
    rows = []
    for source, (method, entry) in product(data.sources(), METHODS.items()):
        chosen = data.of(source=source, method=method)
        # Methods that correct frames together have other tables, since their time is not spent separately on each
        # frame.
        if not chosen or entry.as_sequence or entry.calibrated:
            continue
        steps, seconds = (
            mean(values) for values in zip(*((m.iterations, m.final.seconds) for m in chosen), strict=True)
        )
        worse = [m.made_worse for m in chosen if m.start is not None]
        rows.append(
            {
                "frames": source,
                "method": entry.label,
                "runs": str(len(chosen)),
                "iterations": f"{steps:.1f}" if steps else NO_VALUE,
                "s per frame": f"{seconds:.2f}",
                "ms per iteration": f"{1e3 * seconds / steps:.0f}" if steps else NO_VALUE,
                "made worse": f"{100 * mean(worse):.1f} %" if worse and method != "start" else NO_VALUE,
            }
        )
    return table_of("speed", rows)


def pair_table(data: Measurements) -> Table | None:
    """Times of the default solver and of the paper's setting from the same starts."""
    rows, found = [], pairs(data)
    for source, error in dict.fromkeys((pair.source, pair.error_deg) for pair in found):
        chosen = [pair for pair in found if (pair.source, pair.error_deg) == (source, error) and pair.gained]
        steps = [steps_to_final(m) for m in data.of(source=source, method="ours", error_deg=error)]
        reached = [pair.ours for pair in chosen if pair.ours is not None]
        rows.append(
            {
                "frames": source,
                "initial error": start_label(error),
                "pairs": str(len(chosen)),
                "s, paper's setting": f"{median(pair.papers for pair in chosen):.2f}" if chosen else NO_VALUE,
                "s, ours": f"{median(reached):.2f}" if reached else NO_VALUE,
                "times faster": f"{median(pair.ratio for pair in chosen):.1f}" if chosen else NO_VALUE,
                "never reached": str(len(chosen) - len(reached)),
                f"iterations to within {NEAR_FINAL}": f"{median(steps):g}",
            }
        )
    return table_of("pairs", rows, steps=PAPERS_STEPS, gained=MIN_GAIN)


def worse_table(data: Measurements) -> Table | None:
    """Runs of the default solver whose final Dice is more than 0.01 below the initial Dice."""
    rows = [
        {
            "frames": m.run.source,
            "domain": DOMAIN_LABELS[m.run.domain],
            "frame": str(m.run.frame),
            "method": METHODS[m.run.method].label,
            "initial error": start_label(m.run.error_deg),
            "initial Dice": DICE.text([m.start]),
            "Dice": DICE.text([m.final]),
        }
        for m in data.default_solver()
        if m.made_worse
    ]
    return table_of("worse", rows)


def stage_table(stages: dict[str, float]) -> Table | None:
    """Time of each stage [ms]."""
    return table_of("stages", [{"stage": name, "ms": f"{value:.1f}"} for name, value in stages.items()])


def occlusion_table(data: Measurements) -> Table | None:
    """Scores of the default solver with unknown occluders, with given occluder pixels, and with a proposed ignore
    mask."""
    methods = "ours", "ours_given", "ours_proposed"
    return _table(data, "occlusion", OCCLUSION, methods, (DICE, JOINT_MAE))


def camera_table(data: Measurements) -> Table | None:
    """Scores with one camera and with all cameras optimized jointly."""
    methods = "ours", "stereo", "stereo_posed"
    return _table(data, "cameras", "regular", methods, (DICE, JOINT_MAE, VISIBLE_MAE, TIP_DEPTH))


def calibration_table(data: Measurements) -> Table | None:
    """Scores of the default solver, of one calibration of the recording, and of the solver after that calibration."""
    return _table(data, "calibration", "regular", ("ours", "calibrated", "calibrated_ours"), (DICE,))


def _table(
    data: Measurements, table: str, domain: str, methods: tuple[str, ...], figures: tuple[Figure, ...]
) -> Table | None:
    """Table with one row per source, initial error and method, over frames measured with all methods."""
    rows = []
    for source in data.sources():
        errors = {m.run.error_deg for m in data.of(source=source, domain=domain, method=methods[-1])}
        for error in sorted(errors, key=lambda error: -1.0 if error is None else error):
            runs = {
                name: {m.run.frame: m for m in data.of(source=source, domain=domain, method=name, error_deg=error)}
                for name in methods
            }
            frames = sorted(set.intersection(*(set(found) for found in runs.values())))
            if not frames:
                continue
            results = [(METHODS[name].label, [found[frame].final for frame in frames]) for name, found in runs.items()]
            for label, found in [("not corrected", [runs["ours"][frame].start for frame in frames]), *results]:
                row: Row = {
                    "frames": source,
                    "number": str(len(frames)),
                    "initial error": start_label(error),
                    "method": label,
                }
                rows.append(row | {figure.heading: figure.text(found) for figure in figures})
    return table_of(table, rows, share=100 * SHARE)


_TOGETHER = {"sequence": "ours", "temporal": "paper"}
"""Methods that correct frames together -> corresponding method for single frames."""


def sequence_table(data: Measurements) -> Table | None:
    """Scores of frames corrected together and of the same frames corrected separately."""
    found = [m for method in _TOGETHER for m in data.of(method=method)]
    rows = []
    keys = dict.fromkeys((m.run.source, m.run.domain, m.run.error_deg) for m in found)
    for (source, domain, error), (method, single) in product(keys, _TOGETHER.items()):
        together = data.of(source=source, domain=domain, method=method, error_deg=error)
        if not together:
            continue
        after, before = [m.final for m in together], [m.start for m in together]
        warm = [m.final.seconds for m in together if m.stopped == "warm"]
        alone = {m.run.frame: m for m in data.of(source=source, domain=domain, method=single, error_deg=error)}
        both = [m for m in together if m.run.frame in alone]
        rows.append(
            {
                "frames": source,
                "domain": DOMAIN_LABELS[domain],
                "initial error": start_label(error),
                "method": METHODS[method].label,
                "number": str(len(together)),
                "Dice": Cell(DICE.text(after), f"before: {DICE.text(before)}"),
                "joint MAE [deg]": Cell(JOINT_MAE.text(after), f"before: {JOINT_MAE.text(before)}"),
                "MAE of visible joints [deg]": VISIBLE_MAE.text(after),
                "s per warm frame": Cell(f"{median(warm):.2f}" if warm else NO_VALUE, counted(len(warm), "frame")),
                "in both": str(len(both)),
                "Dice alone": DICE.text(alone[m.run.frame].final for m in both),
                "Dice together": DICE.text(m.final for m in both),
            }
        )
    return table_of("sequence", rows)


def room_table(data: Measurements) -> Table | None:
    """Scores in other rooms of the default solver, for single frames and sequences, and of ACS."""

    def worse(runs: Sequence[Measurement]) -> Cell:
        return Cell(DICE.text(scores(runs)), f"worse than initially: {sum(m.made_worse for m in runs)} of {len(runs)}")

    rows = []
    for source, half in product(data.sources(ROOMS), get_args(Half)):
        alone, acs, together = (data.in_rooms(source, half, method) for method in ("ours", "acs", "sequence"))
        if alone:
            rows.append(
                {
                    "camera": source.removeprefix(ROOMS).strip(),
                    "rooms": half,
                    "number": str(len({m.run.domain for m in alone})),
                    "initial Dice": DICE.text(m.start for m in alone),
                    "ours": worse(alone),
                    "ACS, our schedule": DICE.text(scores(acs)),
                    "ours, sequence mode": worse(together),
                }
            )
    return table_of("rooms", rows)


def image_alone_table(data: Measurements) -> Table | None:
    """Scores of the best network with only the image as input, and of the default solver, by domain."""
    rows = []
    for source in data.sources():
        dice, _ = image_alone(data, source)
        ours = dice.pop("ours")
        for domain in DOMAINS:
            known = {method: found[domain] for method, found in dice.items() if domain in found}
            if not known or domain not in ours:
                continue
            best = max(known, key=lambda method: known[method])
            ahead, label = ours[domain] - known[best], METHODS[best].label
            winner = "neither" if round(ahead, 1) == 0 else "ours" if ahead > 0 else label
            rows.append(
                {
                    "frames": source,
                    "domain": DOMAIN_LABELS[domain],
                    "best image-only network": label,
                    "Dice of this network": f"{known[best]:.1f}",
                    "ours": f"{ours[domain]:.1f}",
                    "winner": f"{winner}, by {abs(ahead):.1f}",
                }
            )
    return table_of("image_alone", rows)


def family_table(data: Measurements) -> Table | None:
    """Scores of instruments absent from the training data."""
    rows = [
        {
            "instrument": source.removeprefix(FAMILY).strip(),
            "domain": domain,
            "runs": str(len(runs)),
            "initial Dice": f"{100 * mean(m.start.dice for m in runs if m.start):.1f}",
            "ours": f"{100 * mean(m.final.dice for m in runs):.1f}",
        }
        for source in data.sources(FAMILY)
        for domain in data.domains(source)
        if (runs := data.of(source=source, domain=domain, method="ours"))
    ]
    return table_of("families", rows)


def verdict_table(data: Measurements) -> Table | None:
    """Verdicts compared with Dice, for each condition and in total."""
    rows = []
    groups = with_verdict(data)
    for name, runs in {**groups, "all": [run for found in groups.values() for run in found]}.items():
        good, known = good_verdicts(runs), roc_area(runs)
        rows.append(
            {
                "condition": name,
                "runs": str(len(runs)),
                "wrong": str(len(wrong_masks(runs))),
                "good": str(len(good)),
                "good, but wrong": str(len(wrong_masks(good))),
                "good, but worse than initially": str(sum(run.made_worse for run in good)),
                "area under the ROC curve": NO_VALUE if known is None else f"{known:.3f}",
            }
        )
    return table_of("verdicts", rows if groups else [], right=MIN_CORRECT_DICE)


def deviation_table(data: Measurements) -> Table | None:
    """Share of joint errors within one and two reported standard deviations."""
    rows = [
        {
            "condition": name,
            "joint positions": str(known[0]),
            "within 1 SD": f"{100 * known[1]:.0f} %",
            "within 2 SD": f"{100 * known[2]:.0f} %",
        }
        for name, runs in with_verdict(data).items()
        if (known := within(runs)) is not None
    ]
    return table_of("deviations", rows)


def sections(data: Measurements, stages: dict[str, float], hand_eye: list[HandEyeRun]) -> dict[str, list[Table]]:
    """Sections of the report: title -> tables."""
    compared = data.compared()
    found: dict[str, list[Table | None]] = {
        "Main table": [*main_tables(data), image_alone_table(compared)],
        "Iterations": [*iteration_tables(data)],
        "Initial error": [*error_tables(compared)],
        "Occlusion": [occlusion_table(data)],
        "Several cameras": [camera_table(data)],
        "Calibration": [calibration_table(data)],
        "Sequence mode": [sequence_table(data)],
        "Other rooms": [room_table(data)],
        "Other instruments": [family_table(data)],
        "Hand-eye calibration": [hand_eye_table(hand_eye)],
        "Verdicts and standard deviations": [verdict_table(data), deviation_table(data)],
        "Speed and safety": [speed_table(compared), pair_table(data), worse_table(data)],
        "Stages": [stage_table(stages)],
    }
    return {title: [table for table in tables if table] for title, tables in found.items()}
