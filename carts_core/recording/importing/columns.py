"""Heuristics for the columns of a table: joints of an arm, poses of its tip, times, and their units."""

import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ...model.instruments import robot_file
from ...model.psm_kinematics import JOINT_NAMES
from ...settings.interchange import ImportOptions
from ..kinematics_table import LENGTH_UNITS, Joint, joints_of
from .cameras import IMAGE_SUFFIXES
from .foreign_tables import ForeignTable
from .found import Import, PartError, Track
from .joint_units import in_si, length_unit, named_length_unit, psm_joints
from .logs import ArmLog, track

_ARM = re.compile(r"(?i)(?:^|[^a-z])(psm(?:\d|(?![a-z\d])))")
_FILLER = set(
    "joint joints j q js jp measured state current position pos positions angle angles value values rad radians deg "
    "degrees degree mm m meter meters column header outer action observation".split()
)
_JOINTS = {
    **{name: name for name in ("yaw", "pitch", "insertion", "roll", "jaw")},
    **dict.fromkeys(("ins", "depth"), "insertion"),
    **dict.fromkeys(("wrist pitch", "wristpitch"), "wrist_pitch"),
    **dict.fromkeys(("wrist yaw", "wristyaw"), "wrist_yaw"),
    **dict.fromkeys(("gripper", "grip", "grasp"), "jaw"),
}
_POSE = {
    **{name: "x" for name in ("x", "tx", "ee x", "tip x", "translation x")},
    **{name: "y" for name in ("y", "ty", "ee y", "tip y", "translation y")},
    **{name: "z" for name in ("z", "tz", "ee z", "tip z", "translation z")},
    **{name: f"q{axis}" for axis in "xyzw" for name in (f"q{axis}", f"orientation {axis}", f"quat {axis}")},
    **{f"rotation {axis}": f"q{axis}" for axis in "xyzw"},
}
_STATE = set("pos position q state observation measured actual rad deg angle value action".split())
"""Words that may accompany a joint name and describe the type of value."""
_POSE_ORDER = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TIMES = (
    *("timestamp", "timestamp ns", "timestamp s", "timestamp ms", "time", "stamp", "t", "time s", "time ms", "time ns"),
)
_FRAMES = (
    *("frame", "frame id", "frame index", "frame number", "frame no", "image", "image id", "image number", "img"),
    *("picture", "file", "filename", "index", "id", ""),
)
_GENERAL = set("motor no nr number axis dof actuator encoder instrument tool robot arm arms channel ch".split())
"""Words of numbered columns that may be joints of a PSM; other words indicate other robots."""
_PSM = set(JOINT_NAMES)
_REACH = 0.5
"""Maximum distance of a tip from its base or camera [m]."""


@dataclass(frozen=True)
class ColumnMeanings:
    """Meanings of the columns of a table."""

    time: str | None
    """Column of times."""
    frame: str | None
    """Column of file names or numbers of images."""
    arms: dict[str, dict[str, str]]
    """Arm -> joint or part of a pose -> column."""
    stated: frozenset[str] = frozenset()
    """Columns chosen by the user, or with unambiguous names; other meanings are guesses."""


def guess_columns(table: ForeignTable, options: ImportOptions) -> ColumnMeanings:
    """Determine the meanings of the columns of a table from the user's choices, then from names, then from
    numbers in names."""
    others = other_robots(options)
    known = [joint.name for joints in others.values() for joint in joints] or [*JOINT_NAMES, "jaw", *_POSE_ORDER]
    for meaning, column in options.columns.items():
        if meaning not in ("time", "frame", *known):
            problem = f"{meaning} is not a known meaning of a column. Allowed are: {', '.join(known)}, time, frame."
            raise PartError("columns", problem, "Correct --columns.")
        if column not in table.columns:
            raise PartError("columns", f"{table.path} has no column {column!r}. It has: {', '.join(table.columns)}.")
    split = {column: _words(column) for column in table.columns}
    words = {column: text for column, text in split.items() if column not in _name_columns(table)}
    words |= {column: _words(name) for column, name in _named_places(table).items()}
    time = options.columns.get("time") or _first(words, _TIMES)
    if time is None and len(table.dates) == 1:
        (time,) = table.dates
    frame = options.columns.get("frame") or _file_names(table) or _first(words, _FRAMES)
    chosen = {joint: column for joint, column in options.columns.items() if joint not in ("time", "frame")}
    stated = set(options.columns.values()) | {column for column in (time, frame) if column}
    if others:
        arm, joints = next(iter(others.items()))
        named = _joints_by_name(table, words, joints, chosen)
        return ColumnMeanings(time, frame, {arm: named}, frozenset({*stated, *named.values()}))
    arms: dict[str, dict[str, str]] = {}
    for column, text in words.items():
        if column in (time, frame):
            continue
        arm = arm_in(column)
        pose = re.search(r"(?i)pose|orientation|quat|(^|[^a-z])cp([^a-z]|$)", column) is not None
        meaning = _meaning(re.sub(r"\bpsm ?\d?\b", "", text).strip(), pose)
        if meaning is not None:
            arms.setdefault(arm, {}).setdefault(meaning, column)
    stated |= {column for found in arms.values() for meaning, column in found.items() if not meaning.startswith("#")}
    arms = {arm: _numbers_to_joints(found) for arm, found in arms.items()}
    for meaning, column in chosen.items():
        arm = arm_in(column)
        arm = arm if arm in arms else next(iter(options.arms), next(iter(arms), ""))
        arms[arm] = {**arms.get(arm, {}), meaning: column}
    usable = {arm: found for arm, found in arms.items() if found.keys() >= _PSM or set(_POSE_ORDER) <= set(found)}
    if not usable and not chosen:
        usable = _numbered_family(words, (time, frame))
    return ColumnMeanings(time, frame, usable, frozenset(stated))


def other_robots(options: ImportOptions) -> dict[str, tuple[Joint, ...]]:
    """Arm -> joints, for given robots other than PSMs."""
    given = {arm: joints_of(robot) for arm, robot in options.robot.items() if robot_file(robot).is_file()}
    return {arm: joints for arm, joints in given.items() if not {joint.name for joint in joints} >= set(JOINT_NAMES)}


@lru_cache(maxsize=64)
def order_of_names(names: tuple[str, ...], joints: tuple[str, ...] = JOINT_NAMES) -> tuple[int, ...] | None:
    """Index of each joint in the logged joint names, such as `outer_yaw`; None if the names are not usable."""
    meanings = [_meaning(_words(name), pose=False) for name in names]
    if set(joints) <= set(meanings):
        return tuple(meanings.index(joint) for joint in joints)
    known = [meaning in joints for meaning in meanings]
    in_place = all(meaning == joint for meaning, joint, there in zip(meanings, joints, known, strict=False) if there)
    if len(set(names)) > 1 and any(known) and not in_place:
        raise PartError(
            "kinematics",
            f"joint states have the names {', '.join(names)}, which do not match {', '.join(joints)} by name or order. "
            "Correct the names, or import the positions from a table.",
            "Use --kinematics.",
        )
    return None


def track_of(
    groups: list[tuple[list[str], np.ndarray]], role: str, joints: tuple[str, ...] = JOINT_NAMES
) -> Track | None:
    """Logged values of a topic, with joint positions in the order of `joints`; None without messages.

    Args:
        groups: result of `decoders.bags.rows`: names in the messages, times and values.
        role: "joints", "jaw" or a pose.
    """
    chosen = []
    for names, rows in groups:
        order = range(rows.shape[1] - 1)
        if role == "joints":
            order = order_of_names(tuple(names), joints) or range(len(joints))
        if max(order) < rows.shape[1] - 1:
            chosen.append(rows[:, [0, *(1 + index for index in order)]])
    rows = np.concatenate(chosen) if chosen else np.empty((0, 2))
    return track(rows[:, 0], rows[:, 1:])


def has_unknown_names(names: tuple[str, ...], joints: tuple[str, ...] = JOINT_NAMES) -> bool:
    """Whether positions have names that match no joints."""
    return len(set(names)) > 1 and order_of_names(names, joints) is None


def arm_in(text: str) -> str:
    """Name of the PSM in a text, in capitals; empty if not found."""
    match = _ARM.search(text.replace("_", " "))
    return match.group(1).upper() if match else ""


def _words(column: str) -> str:
    """Split a name into words and numbers in lower case; `camelCase` is two words."""
    return " ".join(re.findall(r"[a-z]+|\d+", re.sub(r"([a-z])([A-Z])", r"\1 \2", column).lower()))


def _joints_by_name(
    table: ForeignTable, words: dict[str, str], joints: tuple[Joint, ...], chosen: dict[str, str]
) -> dict[str, str]:
    """Map each joint of a robot other than the PSM to the column of the same name; finger joints may lack a column."""
    found: dict[str, str] = {}
    for joint in joints:
        own = _words(joint.name)
        fitting = [column for column, text in words.items() if re.search(rf"(^| ){re.escape(own)}( |$)", text)]
        exact = [column for column in fitting if " ".join(w for w in words[column].split() if w not in _STATE) == own]
        fitting = exact if len(exact) == 1 else fitting
        if joint.name in chosen:
            found[joint.name] = chosen[joint.name]
        elif len(fitting) == 1:
            found[joint.name] = fitting[0]
    if missing := [joint.name for joint in joints if joint.name not in found and "finger" not in joint.name]:
        raise PartError(
            "columns",
            f"{table.path} has no column of {', '.join(missing)}; its columns are {', '.join(table.columns)}.",
            f"Give them: --columns {missing[0]} COLUMN ...",
        )
    return found


def _name_columns(table: ForeignTable) -> dict[str, re.Match[str]]:
    """Columns `name_0`, `name_1` ... with the joint names of a message."""
    found = {}
    for column, cells in table.columns.items():
        match = re.fullmatch(r"(?i)(.*?)(?:joint_?)?names?([._ \[]*)(\d+)\]?", column)
        if match is not None and cells.dtype.kind in "UO":
            found[column] = match
    return found


def _named_places(table: ForeignTable) -> dict[str, str]:
    """Column of a position -> joint name from the column of names."""
    named = {}
    for column, match in _name_columns(table).items():
        names = {str(cell).strip() for cell in table.columns[column]}
        if len(names) != 1:
            raise PartError(
                "columns",
                f"{table.path}, column {column!r} has several names ({', '.join(sorted(names)[:3])}), so the meaning "
                "of positions differs between rows. Reorder the positions, or choose columns with a constant order.",
                "Use --columns.",
            )
        place = re.compile(rf"(?i){re.escape(match[1])}(?:joint_?)?positions?[._ \[]*0*{int(match[3])}\]?")
        for other in table.columns:
            if place.fullmatch(other):
                named[other] = f"{match[1]} {names.pop()}"
                break
    return named


def _file_names(table: ForeignTable) -> str | None:
    """Column whose cells are names of image files."""
    for column, cells in table.columns.items():
        if cells.dtype.kind in "UO" and len(cells):
            hits = sum(str(cell).strip().lower().endswith(IMAGE_SUFFIXES) for cell in cells)
            if hits >= 0.9 * len(cells):
                return column
    return None


def samples(table: ForeignTable, most: int = 30) -> str:
    """Columns of a table with a sample value each, for errors."""
    columns = list(table.columns.items())
    text = ", ".join(f"{name} ({sample(values[0])})" for name, values in columns[:most])
    return f"{text} and {len(columns) - most} more" if len(columns) > most else text


def sample(value: object) -> str:
    """Sample value of a column, for errors."""
    return f"{value:.4g}" if isinstance(value, float | np.floating) else str(value)


def _numbered_family(words: dict[str, str], others: tuple[str | None, ...]) -> dict[str, dict[str, str]]:
    """Group of six or seven columns that differ only in a number, if there is exactly one; its columns are assumed to
    be joints."""
    families: dict[str, dict[str, str]] = {}
    for column, text in words.items():
        number = re.fullmatch(r"(.*?)(\d+)(\D*)", text)
        if number and column not in others and set(f"{number[1]} {number[3]}".split()) <= _GENERAL | _FILLER:
            families.setdefault(f"{number[1]}#{number[3]}", {})[f"#{int(number[2])}"] = column
    fitting = [family for family in families.values() if len(family) in (len(JOINT_NAMES), len(JOINT_NAMES) + 1)]
    found = _numbers_to_joints(fitting[0]) if len(fitting) == 1 else {}
    return {"": found} if found.keys() >= _PSM else {}


def _first(words: dict[str, str], wanted: tuple[str, ...]) -> str | None:
    return next((column for name in wanted for column, text in words.items() if text == name), None)


def _meaning(text: str, pose: bool) -> str | None:
    """Joint, `#n` for the n-th joint, or component of a pose."""
    tokens = [token for token in text.split() if token not in _FILLER]
    bare = " ".join(token for token in tokens if token not in ("pose", "cp", "local", "ee"))
    if bare in _POSE and (pose or bare[0] == "q" or len(bare) == 1):
        return _POSE[bare] if not ("orientation" in text or "quat" in text) else f"q{bare[-1]}"
    bare = " ".join(tokens)
    if text in _POSE:
        return _POSE[text]
    if bare in _JOINTS and not pose:
        return _JOINTS[bare]
    if bare.isdigit() and not pose:
        return f"#{int(bare)}"
    return None


def _numbers_to_joints(found: dict[str, str]) -> dict[str, str]:
    """Replace joint numbers, counted from 0 or 1, by joint names."""
    numbers = sorted(int(key[1:]) for key in found if key.startswith("#"))
    if not numbers:
        return found
    start = 0 if numbers[0] == 0 else 1
    names = (*JOINT_NAMES, "jaw")
    named = {key: column for key, column in found.items() if not key.startswith("#")}
    for number in numbers:
        if 0 <= number - start < len(names):
            # Numbered joints take precedence over names such as roll, which may be angles of the tip.
            named[names[number - start]] = found[f"#{number}"]
    return named


def arm_log(
    table: ForeignTable,
    arm: str,
    found: dict[str, str],
    times: np.ndarray,
    job: Import,
    stated: frozenset[str] = frozenset(),
) -> ArmLog:
    """Log of one arm, in radians and metres.

    Args:
        found: joint or part of a pose -> column.
        times: times of the rows, or indices of their images; NaN for rows without an image.
        stated: columns with a known meaning.
    """
    other = other_robots(job.options).get(arm)
    if other is None and not found.keys() >= _PSM:
        return _pose_log(table, arm, found, times, job, stated)
    order = [joint.name for joint in other] if other is not None else [*JOINT_NAMES, "jaw"]
    known = dict(zip(order, other or psm_joints(arm, order, job), strict=True))
    joints = [known[name] for name in order if name in found]
    columns = [found[joint.name] for joint in joints]
    raw = np.stack([table.numbers(column).astype(np.float64) for column in columns], 1)
    named = [f"{column} {table.units.get(column, '')}".strip() for column in columns]
    values = in_si(raw, joints, job, arm=arm, columns=named, instrument=other is None)
    option = f"--columns {order[0]} COLUMN ..."
    job.found(f"joint positions are read from {', '.join(columns)}.", arm, option, given=stated.issuperset(columns))
    logged = track(times, values)
    if other is not None:
        return ArmLog(arm, joints=logged, names=tuple(joint.name for joint in joints), si=True)
    jaw = None if "jaw" not in found else track(times, values[:, order.index("jaw")])
    if logged is not None:
        logged = replace(logged, values=logged.values[:, : len(JOINT_NAMES)])
    return ArmLog(arm, joints=logged, jaw=jaw, si=True)


def _pose_log(
    table: ForeignTable, arm: str, found: dict[str, str], times: np.ndarray, job: Import, stated: frozenset[str]
) -> ArmLog:
    """Log of an arm from poses of its tip."""
    columns, options = [found[name] for name in _POSE_ORDER], job.options
    values = np.stack([table.numbers(column).astype(np.float64) for column in columns], 1)
    named = " ".join(f"{column} {table.units.get(column, '')}" for column in columns[:3])
    given = options.length_unit or named_length_unit(named)
    unit = given or length_unit(float(np.nanmax(np.abs(values[:, :3]))), _REACH, arm, "the tip's position")
    values[:, :3] *= LENGTH_UNITS[unit]
    job.found(f"lengths are in {unit}.", arm, "--length-unit", given=given is not None)
    poses = track(times, values)
    seen = arm in options.base
    frame = "camera, since a base frame is given" if seen else "arm's base"
    text = f"the tip pose is read from {', '.join(columns)}, in the frame of the {frame}."
    job.found(text, arm, "" if seen else f"--base {arm} FILE", given=seen and stated.issuperset(columns))
    log = ArmLog(arm, poses=poses if seen else None, local_poses=None if seen else poses, si=True)
    if "jaw" not in found:
        return log
    opening = table.numbers(found["jaw"]).astype(np.float64)
    degrees = options.units.get("jaw", options.angle_unit) == "deg" or re.search(r"(?i)deg|°", found["jaw"]) is not None
    opening = opening * (np.pi / 180 if degrees else 1.0) * (-1.0 if "jaw" in options.flip else 1.0)
    return replace(log, jaw=track(times, opening))
