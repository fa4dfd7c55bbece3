"""Which columns of a table are an arm's joints, its tip's pose, and times; and in which units. All of it is guesses."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...errors import SequenceError
from ...model.psm_kinematics import JOINT_NAMES
from ...settings.importing import SECONDS, Clock, ImportOptions
from .foreign_tables import ForeignTable
from .found import Note
from .logs import ArmLog, track

_ARM = re.compile(r"(?i)(?:^|[^a-z])(psm\d?)(?![a-z])")
_FILLER = set(
    "joint joints j q js jp measured state current position pos positions angle angles value values rad radians deg "
    "degrees degree mm m meter meters column header outer action observation".split()
)
_JOINTS = {
    "yaw": "yaw",
    "pitch": "pitch",
    "insertion": "insertion",
    "ins": "insertion",
    "depth": "insertion",
    "roll": "roll",
    "wrist pitch": "wrist_pitch",
    "wristpitch": "wrist_pitch",
    "wrist yaw": "wrist_yaw",
    "wristyaw": "wrist_yaw",
    "jaw": "jaw",
    "gripper": "jaw",
    "grip": "jaw",
    "grasp": "jaw",
}
_POSE = {
    **{name: "x" for name in ("x", "tx", "ee x", "tip x", "translation x")},
    **{name: "y" for name in ("y", "ty", "ee y", "tip y", "translation y")},
    **{name: "z" for name in ("z", "tz", "ee z", "tip z", "translation z")},
    **{name: f"q{axis}" for axis in "xyzw" for name in (f"q{axis}", f"orientation {axis}", f"quat {axis}")},
    **{f"rotation {axis}": f"q{axis}" for axis in "xyzw"},
}
_POSE_ORDER = ("x", "y", "z", "qx", "qy", "qz", "qw")
_TIMES = (
    "timestamp",
    "timestamp ns",
    "timestamp s",
    "timestamp ms",
    "time",
    "stamp",
    "t",
    "time s",
    "time ms",
    "time ns",
)
_FRAMES = ("frame", "frame id", "frame index", "frame number", "image", "image id", "index", "id", "file", "filename")
_DEGREES_FROM = (3.1, 1.4, 7.0, 1.8, 1.8)
"""[rad] Yaw, pitch, roll, wrist pitch and wrist yaw of no PSM turn that far, so larger angles are degrees."""
_MILLIMETRES_FROM = 1.0
"""[m] No instrument is inserted that far."""


@dataclass(frozen=True)
class ColumnMeanings:
    """Columns by what they mean."""

    time: str | None
    frame: str | None
    arms: dict[str, dict[str, str]]
    """Arm -> joint or part of a pose -> column."""


def guess_columns(table: ForeignTable, options: ImportOptions) -> ColumnMeanings:
    """What the columns of a table mean; a person's choice comes before guesses.

    Raises:
        SequenceError: a chosen column is not there.
    """
    words = {column: " ".join(re.findall(r"[a-z]+|\d+", _spaced(column))) for column in table.columns}
    time = options.columns.get("time") or _first(words, _TIMES)
    frame = options.columns.get("frame") or _first(words, _FRAMES)
    arms: dict[str, dict[str, str]] = {}
    for column, text in words.items():
        if column in (time, frame):
            continue
        match = _ARM.search(column.replace("_", " "))
        arm = match.group(1).upper() if match else ""
        meaning = _meaning(re.sub(r"\bpsm ?\d?\b", "", text).strip(), _mentions_pose(column))
        if meaning is not None:
            arms.setdefault(arm, {}).setdefault(meaning, column)
    arms = {arm: _numbers_to_joints(found) for arm, found in arms.items()}
    chosen = {joint: column for joint, column in options.columns.items() if joint not in ("time", "frame")}
    if chosen:
        arms = {next(iter(options.arms), next(iter(arms), "")): chosen}
    for column in options.columns.values():
        if column not in table.columns:
            raise SequenceError(f"{table.path} has no column {column!r}. It has: {', '.join(table.columns)}.")
    usable = {arm: found for arm, found in arms.items() if _has_joints(found) or _has_pose(found)}
    if not usable and not chosen:
        usable = _numbered_family(words, (time, frame))
    return ColumnMeanings(time, frame, usable)


def _numbered_family(words: dict[str, str], others: tuple[str | None, ...]) -> dict[str, dict[str, str]]:
    """The only six or seven columns that differ in nothing but a number: joints under a name of their own."""
    families: dict[str, dict[str, str]] = {}
    for column, text in words.items():
        number = re.fullmatch(r"(.*?)(\d+)(\D*)", text)
        if number and column not in others:
            families.setdefault(f"{number[1]}#{number[3]}", {})[f"#{int(number[2])}"] = column
    fitting = [family for family in families.values() if len(family) in (len(JOINT_NAMES), len(JOINT_NAMES) + 1)]
    found = _numbers_to_joints(fitting[0]) if len(fitting) == 1 else {}
    return {"": found} if _has_joints(found) else {}


def _spaced(column: str) -> str:
    return re.sub(r"([a-z])([A-Z])", r"\1 \2", column).lower()


def _first(words: dict[str, str], wanted: tuple[str, ...]) -> str | None:
    for name in wanted:
        for column, text in words.items():
            if text == name:
                return column
    return None


def _mentions_pose(column: str) -> bool:
    return re.search(r"(?i)pose|orientation|quat|(^|[^a-z])cp([^a-z]|$)", column) is not None


def _meaning(text: str, pose: bool) -> str | None:
    """Joint, `#n` for the n-th one, or part of a pose."""
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
    """The n-th joint by its name; numbers begin with 0 or 1."""
    numbers = sorted(int(key[1:]) for key in found if key.startswith("#"))
    if not numbers:
        return found
    start = 0 if numbers[0] == 0 else 1
    names = (*JOINT_NAMES, "jaw")
    named = {key: column for key, column in found.items() if not key.startswith("#")}
    for number in numbers:
        if 0 <= number - start < len(names):
            # Numbered joints come before names such as roll, which may be angles of the tip.
            named[names[number - start]] = found[f"#{number}"]
    return named


def _has_joints(found: dict[str, str]) -> bool:
    return set(JOINT_NAMES) <= set(found)


def _has_pose(found: dict[str, str]) -> bool:
    return set(_POSE_ORDER) <= set(found)


def seconds(table: ForeignTable, column: str, clock: Clock | None, note: Callable[[Note], None]) -> np.ndarray:
    """A column of times in seconds; its unit is guessed where it is not given.

    Raises:
        SequenceError: times do not increase.
    """
    values = table.numbers(column)
    if clock is None:
        clock = guess_clock(np.asarray(values, np.float64))
        note(Note("guessed", f"{table.path.name}: times of column {column!r} are in {clock} (change: --clock)."))
    if len(values) > 1 and (backwards := np.diff(values.astype(np.float64)) < 0).any():
        row = int(np.flatnonzero(backwards)[0]) + 1
        raise SequenceError(
            f"{table.path}, column {column!r}: times go back from {values[row - 1]} to {values[row]}, row {row + 1}. "
            "Sort the rows, or name another column: --columns time COLUMN."
        )
    return np.asarray(values, np.float64) * SECONDS[clock]


def guess_clock(values: np.ndarray) -> Clock:
    """The unit of times, by their size (where they count from 1970) or their spacing."""
    largest = float(np.nanmax(np.abs(values))) if len(values) else 0.0
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11), ("s", 1e8)):
        if largest >= least:
            return unit  # pyright: ignore[reportReturnType]
    step = float(np.median(np.diff(values))) if len(values) > 1 else 0.0
    for unit, least in (("ns", 9e5), ("us", 9e2), ("ms", 0.9)):
        if step >= least:
            return unit  # pyright: ignore[reportReturnType]
    return "s"


def arm_log(
    table: ForeignTable,
    arm: str,
    found: dict[str, str],
    times: np.ndarray,
    options: ImportOptions,
    note: Callable[[Note], None],
) -> ArmLog:
    """The log of one arm from its columns, in radians and metres.

    Raises:
        SequenceError: a cell is no number, or a joint to be flipped does not exist.
    """
    if _has_joints(found):
        values = np.stack([table.numbers(found[name]).astype(np.float64) for name in JOINT_NAMES], 1)
        columns = [found[name] for name in JOINT_NAMES]
        angles = [index for index in range(6) if index != 2]
        degrees, millimetres = _units(values[:, angles], values[:, 2], columns, options)
        values[:, angles] *= np.pi / 180 if degrees else 1.0
        values[:, 2] *= 1e-3 if millimetres else 1.0
        for joint in options.flip:
            if joint not in JOINT_NAMES:
                raise SequenceError(f"--flip {joint} is no joint. Joints are: {', '.join(JOINT_NAMES)}.")
            values[:, JOINT_NAMES.index(joint)] *= -1.0
        note(Note("guessed", f"{arm}: joints are {', '.join(columns)} (change: --columns yaw COLUMN ...)."))
        log = ArmLog(arm, joints=track([(time, *row) for time, row in zip(times, values, strict=True)]))
    else:
        values = np.stack([table.numbers(found[name]).astype(np.float64) for name in _POSE_ORDER], 1)
        degrees, millimetres = _units(np.zeros((1, len(_DEGREES_FROM))), values[:, :3], [found["x"]], options)
        values[:, :3] *= 1e-3 if millimetres else 1.0
        columns = [found[name] for name in _POSE_ORDER]
        poses = track([(time, *row) for time, row in zip(times, values, strict=True)])
        seen = arm in options.base
        frame = "camera, since --base is given" if seen else "arm's base (if it is the camera: --base)"
        note(Note("guessed", f"{arm}: the tip's pose is {', '.join(columns)}, in the frame of the {frame}."))
        log = ArmLog(arm, poses=poses if seen else None, local_poses=None if seen else poses)
    if "jaw" in found:
        opening = table.numbers(found["jaw"]).astype(np.float64) * (np.pi / 180 if degrees else 1.0)
        log = replace(log, jaw=track(list(zip(times, opening, strict=True))))
    note(
        Note(
            "guessed",
            f"{arm}: angles are in {'deg' if degrees else 'rad'}, lengths in {'mm' if millimetres else 'm'} "
            "(change: --angle-unit, --length-unit).",
        )
    )
    return log


def _units(angles: np.ndarray, lengths: np.ndarray, columns: list[str], options: ImportOptions) -> tuple[bool, bool]:
    """Whether angles are degrees and lengths millimetres: as given, as a column's name says, or by their size."""
    text = " ".join(columns).lower()
    degrees = re.search(r"deg|°", text) is not None or bool((np.nanmax(np.abs(angles), 0) > _DEGREES_FROM).any())
    millimetres = re.search(r"(^|[^a-z])mm([^a-z]|$)", text) is not None or float(np.nanmax(np.abs(lengths))) > (
        _MILLIMETRES_FROM
    )
    if options.angle_unit is not None:
        degrees = options.angle_unit == "deg"
    if options.length_unit is not None:
        millimetres = options.length_unit == "mm"
    return degrees, millimetres
