"""The report: one page, the plots beside it, and the same numbers as JSON and CSV."""

import csv
import io
import json
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from string import Template

from ...files import OutputPath, csv_cell, write_text
from ...html import STYLE, Table, anchor, figure_html, section_html, table_html
from . import paper
from .accuracy_tables import error_tables, iteration_tables, main_tables
from .figures import write_figures
from .frame import TOLERANCE
from .further_tables import calibration_table, camera_table, occlusion_table, room_table, sequence_table
from .hand_eye import HandEyeRun, hand_eye_table, hand_eye_targets
from .image_alone import image_alone_table
from .measurement import BEST_OF, Measurement
from .page import PAGE
from .speed_tables import pair_table, speed_table, stage_table, worse_table
from .statistics import Measurements
from .target import Target
from .targets import targets
from .verdicts import deviation_table, family_table, verdict_table


@dataclass(frozen=True)
class Facts:
    """What the report says about its origin."""

    scope: str
    """`quick` or `full`."""
    planned: int
    """Number of runs of the plan, measured or not."""
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

    Args:
        folder: where to.
        measurements: the runs.
        facts: where they come from.
        stages: of an iteration -> milliseconds; may be empty.
        hand_eye: calibrations of another robot; may be empty.

    Raises:
        CartsError: the folder cannot be written to.
    """
    data = Measurements(measurements)
    verdicts = [*targets(data), *hand_eye_targets(hand_eye)]
    sections = _sections(data, stages, hand_eye)
    figures = write_figures(data.compared(), folder / "figures")
    rows = [_row(measurement) for measurement in measurements]
    document = {
        "format": "carts-benchmark/1",
        "facts": asdict(facts),
        "measured": len(measurements),
        "machines": _machines(measurements),
        "targets": [asdict(target) for target in verdicts],
        "tables": [asdict(table) for _, tables in sections for table in tables],
        "stages_ms": stages,
        "hand_eye": [asdict(run) for run in hand_eye],
        "paper": {
            "source": paper.SOURCE,
            "dice": paper.DICE,
            "dice_by_iterations": paper.DICE_BY_ITERATIONS,
            "dice_by_error": paper.DICE_BY_ERROR,
            "mae_by_error": paper.MAE_BY_ERROR,
        },
        "runs": rows,
    }
    write_text(folder / "results.json", json.dumps(document, indent=1))
    write_text(folder / "results.csv", _csv(rows))
    page = Template(PAGE).substitute(
        style=STYLE,
        facts=_facts(facts, measurements),
        targets=_targets(verdicts),
        contents="".join(f'<a href="#{anchor(title)}">{escape(title)}</a> ' for title, _ in sections),
        sections="".join(_section(title, tables) for title, tables in sections),
        figures="".join(figure_html(caption, path.relative_to(folder.path)) for caption, path in figures.items()),
        tolerance=f"{TOLERANCE:g}",
        source=escape(paper.SOURCE),
    )
    path = folder / "report.html"
    write_text(path, page)
    return path.path


def _sections(
    data: Measurements, stages: dict[str, float], hand_eye: list[HandEyeRun]
) -> list[tuple[str, list[Table]]]:
    """Title -> tables."""
    compared = data.compared()
    return [
        ("Main table", [*main_tables(data), *_known(image_alone_table(compared))]),
        ("Iterations", iteration_tables(data)),
        ("Error at the start", error_tables(compared)),
        ("Occlusion", _known(occlusion_table(data))),
        ("Several cameras", _known(camera_table(data))),
        ("Calibration", _known(calibration_table(data))),
        ("Sequence mode", _known(sequence_table(data))),
        ("Other rooms", _known(room_table(data))),
        ("Other instruments", _known(family_table(data))),
        ("Hand-eye calibration", _known(hand_eye_table(hand_eye))),
        ("Verdicts and deviations", _known(verdict_table(data), deviation_table(data))),
        ("Speed and safety", _known(speed_table(compared), pair_table(data), worse_table(data))),
        ("Stages", [stage_table(stages)] if stages else []),
    ]


def _known(*tables: Table | None) -> list[Table]:
    return [table for table in tables if table is not None]


def _row(measurement: Measurement) -> dict[str, object]:
    """One run, flat."""
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


def _machines(measurements: list[Measurement]) -> list[str]:
    return sorted({measurement.machine for measurement in measurements})


def _facts(facts: Facts, measurements: list[Measurement]) -> str:
    machines = _machines(measurements)
    lines = {
        "runs": f"{len(measurements)} of {facts.planned} measured ({facts.scope})",
        **{f"{name} frames": description for name, description in facts.sources.items()},
        "machine": "; ".join(machines) or "-",
        "carts": f"{facts.version}, measured code {facts.code[:12]}",
        "weights": facts.weights[:12],
    }
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in lines.items())
    warnings = []
    if len(measurements) < facts.planned:
        warnings.append("Not everything has been measured yet; run the same command again to go on.")
    if len(machines) > 1:
        warnings.append("Runs come from more than one machine or number of threads, so seconds do not compare.")
    notes = "".join(f'<p class="warning">{escape(warning)}</p>' for warning in warnings)
    return f'<table class="facts">{rows}</table>{notes}'


def _targets(verdicts: list[Target]) -> str:
    words = {True: ("met", "met"), False: ("missed", "missed"), None: ("open", "open")}
    rows = "".join(
        f"<tr><td>{escape(target.what)}<small>{escape(target.basis)}</small></td>"
        f"<td>{escape(target.target)}</td><td>{escape(target.reached)}</td>"
        f'<td class="{words[target.met][0]}">{words[target.met][1]}</td><td>{escape(target.reference)}</td></tr>'
        for target in verdicts
    )
    header = "".join(f"<th>{name}</th>" for name in ("what", "target", "reached", "verdict", "reference"))
    return f'<table class="targets"><thead><tr>{header}</tr></thead><tbody>{rows}</tbody></table>'


def _section(title: str, tables: list[Table]) -> str:
    return section_html(title, "".join(map(table_html, tables)) or "<p>Not measured.</p>")
