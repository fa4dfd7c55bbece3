"""Tables of what goes beyond one frame in one camera: occluders, several cameras, a calibration, a sequence."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product
from statistics import median
from typing import get_args

from ...html import Cell, Table
from ...wording import counted
from .measurement import Measurement, Score
from .methods import METHODS
from .occlusion import OCCLUSION, SHARE
from .rooms import Half
from .statistics import Measurements, Spread
from .tables import DOMAIN_LABELS, NOTHING, begun, spread_text


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
            for label, scores in [("not corrected", starts), *results]:
                cells = (column.cell(scores) for column in columns)
                rows.append((Cell(source), Cell(str(len(frames))), Cell(begun(error)), Cell(label), *cells))
    header = ("frames", "number", "error at the start", "method", *(column.heading for column in columns))
    return Table(title, caption, header, tuple(rows)) if rows else None


def _errors(measurements: Iterable[Measurement]) -> list[float | None]:
    found = {measurement.run.error_deg for measurement in measurements}
    return sorted(found, key=lambda error: -1.0 if error is None else error)
