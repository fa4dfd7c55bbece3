"""What a sequence file says, read and checked: cameras with their images, arms with their joint positions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..camera import Camera
from ..errors import SequenceError
from ..resources import shipped_robot
from ..robot import Robot
from ..scene import Arm, Light, Scene
from .calibration import resolve_robot, take_camera, take_transform
from .images import ImageFiles, ImageSource
from .joints import JointColumns, take_joints
from .patterns import FrameId, expand, frame_files, is_glob, is_per_frame
from .table import Table, read_table
from .toml_table import TomlTable, closest, read_toml
from .video import SUFFIXES, Video

FORMAT = "carts-sequence/1"
"""Value of the key `format`."""

_SHOWN_MISSING = 3


@dataclass(frozen=True)
class CameraInput:
    """A camera and the files that belong to it, by domain."""

    camera: Camera
    images: Mapping[str, ImageSource]
    masks: Mapping[str, tuple[Path | None, ...]]
    """Mask file of every frame, None for a frame that has none; empty when the sequence has no masks."""
    background: Mapping[str, Path]


@dataclass(frozen=True)
class ArmInput:
    """An arm and its joint positions in every frame."""

    arm: Arm
    measured_joints: tuple[str, ...]
    measured: Float[np.ndarray, "frames dofs"]
    truth: Float[np.ndarray, "frames dofs"] | None


@dataclass(frozen=True)
class Description:
    """A sequence file, read and checked."""

    path: Path
    name: str
    scene: Scene
    domains: tuple[str, ...]
    frame_ids: tuple[str, ...]
    timestamps: Float[np.ndarray, " frames"] | None
    cameras: Mapping[str, CameraInput]
    arms: Mapping[str, ArmInput]


@dataclass(frozen=True)
class _Rows:
    """The rows of a sequence, as the `[kinematics]` table gives them."""

    table: Table | None
    truth: Table | None
    frame_column: str
    frame_pattern: str
    delimiter: str
    frame_ids: tuple[str, ...]
    timestamps: np.ndarray | None
    video_frames: tuple[int, ...]
    _tables: dict[Path, Table] = field(default_factory=dict)

    def other(self, path: Path) -> Table:
        """Another table with the same frames in the same order."""
        if path not in self._tables:
            table = read_table(path, self.delimiter)
            ids = _frame_ids(table, self.frame_column, self.frame_pattern)
            _check_same_frames(table, ids, self.frame_ids)
            self._tables[path] = table
        return self._tables[path]


def read_description(path: Path, progress: Callable[[str], None] | None = None) -> Description:
    """Read a sequence file and everything that it points at, images excepted.

    Args:
        path: the TOML file.
        progress: called with a line for people while robots are loaded.

    Raises:
        SequenceError: the file or something it points at is missing or wrong.
        RobotError: a robot or one of its meshes is missing or wrong.
    """
    root = read_toml(path)
    root.take_choice("format", (FORMAT,), "(none)")
    name = root.take("name", str, path.stem)
    root.take("description", str, "")
    domains = _take_domains(root)
    rows = _take_rows(root.take_table("kinematics"))
    light = _take_light(root.take_table("light"))
    robots: dict[tuple[Path, str | None], Robot] = {}
    arms = [_take_arm(table, rows, robots, progress) for table in root.take_tables("arms")]
    cameras = [_take_camera_input(table, rows, domains) for table in root.take_tables("cameras")]
    root.finish()
    scene = Scene(tuple(entry.arm for entry in arms), tuple(entry.camera for entry in cameras), light)
    return Description(
        path=path,
        name=name,
        scene=scene,
        domains=domains,
        frame_ids=rows.frame_ids,
        timestamps=rows.timestamps,
        cameras={entry.camera.name: entry for entry in cameras},
        arms={entry.arm.name: entry for entry in arms},
    )


def _take_domains(root: TomlTable) -> tuple[str, ...]:
    domains = root.take("domains", list, ["regular"])
    if not domains or not all(isinstance(domain, str) and domain for domain in domains):
        raise root.error("domains", f'is {domains!r}. Give names, say domains = ["regular", "smoke"].')
    if len(set(domains)) < len(domains):
        raise root.error("domains", f"names one twice: {', '.join(domains)}.")
    return tuple(domains)


def _take_light(table: TomlTable) -> Light:
    values: dict[str, Any] = {}
    for setting in fields(Light):
        if setting.name in table:
            value = table.take(setting.name, list if setting.name == "position" else float)
            values[setting.name] = tuple(value) if isinstance(value, list) else float(value)
        else:
            table.take(setting.name, object, None)
    table.finish()
    if len(values.get("position", (0, 0, 0))) != 3:
        raise table.error("position", "must have three numbers [m], in the camera's frame.")
    return Light(**values)


def _take_rows(section: TomlTable) -> _Rows:
    delimiter = section.take("delimiter", str, ",")
    if len(delimiter) != 1:
        raise section.error("delimiter", f"is {delimiter!r}, but must be one character.")
    table = read_table(section.path(section.take("table", str)), delimiter)
    frame_column = section.take("frame", str, "frame")
    frame_pattern = section.take("frame_id", str, "{frame}")
    if "{frame" not in frame_pattern:
        raise section.error("frame_id", f'is {frame_pattern!r}. It must contain {{frame}}, say "{{frame:03d}}".')
    frame_ids = _frame_ids(table, frame_column, frame_pattern)
    timestamps = None
    if column := section.take("timestamp", str, ""):
        timestamps = table.numbers(column, section.name("timestamp"))
    video_frames = tuple(range(len(table)))
    if column := section.take("video_frame", str, ""):
        video_frames = _video_frames(table, column, section)
    truth_path = section.take("truth", str, "")
    section.finish()
    rows = _Rows(table, None, frame_column, frame_pattern, delimiter, frame_ids, timestamps, video_frames)
    if not truth_path:
        return rows
    truth = rows.other(section.path(truth_path))
    return _Rows(table, truth, frame_column, frame_pattern, delimiter, frame_ids, timestamps, video_frames)


def _video_frames(table: Table, column: str, section: TomlTable) -> tuple[int, ...]:
    numbers = table.numbers(column, section.name("video_frame"))
    if (wrong := np.flatnonzero((numbers < 0) | (numbers != np.round(numbers)))).size:
        raise SequenceError(
            f"{table.path}, line {table.lines[wrong[0]]}, column {column!r}: {numbers[wrong[0]]:g} is not a frame "
            "number. Frames of a video are counted 0, 1, 2, ..."
        )
    return tuple(int(number) for number in numbers)


def _frame_ids(table: Table, column: str, pattern: str) -> tuple[str, ...]:
    key = f"{table.path}, column {column!r}"
    ids = tuple(expand(pattern, key, frame=FrameId(cell)) for cell in table.text(column, "`frame` in [kinematics]"))
    lines: dict[str, int] = {}
    for frame_id, line in zip(ids, table.lines, strict=True):
        if not frame_id:
            raise SequenceError(f"{key}, line {line}: the frame has no id. Fill it in.")
        if frame_id in lines:
            raise SequenceError(
                f"{key}: frame {frame_id!r} is in line {lines[frame_id]} and again in line {line}. "
                "Remove one of them, or number the frames anew."
            )
        lines[frame_id] = line
    return ids


def _check_same_frames(table: Table, ids: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    if len(ids) != len(wanted):
        raise SequenceError(
            f"{table.path} has {len(ids)} rows, but the kinematics table has {len(wanted)}. "
            "All tables of a sequence must have the same frames in the same order."
        )
    for given, expected, line in zip(ids, wanted, table.lines, strict=True):
        if given != expected:
            raise SequenceError(
                f"{table.path}, line {line} is frame {given!r}, but the kinematics table has frame {expected!r} there. "
                "All tables of a sequence must have the same frames in the same order."
            )


def _take_arm(
    table: TomlTable,
    rows: _Rows,
    robots: dict[tuple[Path, str | None], Robot],
    progress: Callable[[str], None] | None,
) -> ArmInput:
    name = table.take("name", str)
    urdf = resolve_robot(table, {"psm_lnd": shipped_robot()})
    base_link = table.take("base_link", str, None)
    if (key := (urdf.resolve(), base_link)) not in robots:
        robots[key] = Robot.load(urdf, base_link=base_link, progress=progress)
    robot = robots[key]
    T_world_base = take_transform(table, "T_world_base", np.eye(4).tolist())
    columns = take_joints(table, robot)
    measured = _take_positions(table, "table", rows.table, rows, columns)
    truth = _take_positions(table, "truth", rows.truth, rows, columns)
    table.finish()
    assert measured is not None
    return ArmInput(Arm(name, robot, T_world_base), columns.measured, measured, truth)


def _take_positions(
    table: TomlTable, key: str, default: Table | None, rows: _Rows, columns: JointColumns
) -> np.ndarray | None:
    own = table.take(key, str, "")
    source = rows.other(table.path(own)) if own else default
    return None if source is None else columns.read(source)


def _take_camera_input(table: TomlTable, rows: _Rows, domains: tuple[str, ...]) -> CameraInput:
    camera = take_camera(table)
    images = {
        domain: _images(table, pattern, rows, domain, camera.name)
        for domain, pattern in _by_domain(table, "images", domains, required=True).items()
    }
    sparse = table.take("sparse_masks", bool, False)
    masks = {
        domain: _masks(table, pattern, rows, domain=domain, camera=camera.name, sparse=sparse)
        for domain, pattern in _by_domain(table, "masks", domains).items()
    }
    background: dict[str, Path] = {}
    for domain, pattern in _by_domain(table, "background", domains).items():
        path = table.path(expand(pattern, table.name("background"), domain=domain, camera=camera.name))
        if not path.is_file():
            raise table.error("background", f"points at {path}, which is missing. Correct the path or remove the key.")
        background[domain] = path
    table.finish()
    return CameraInput(camera, images, masks, background)


def _by_domain(table: TomlTable, key: str, domains: tuple[str, ...], required: bool = False) -> dict[str, str]:
    """Pattern of every domain: text is for all domains, a table names them one by one."""
    value = table.take(key, (str, dict)) if required else table.take(key, (str, dict), {})
    if isinstance(value, str):
        if required and len(domains) > 1 and "{domain" not in value:
            raise table.error(
                key,
                f"is {value!r} for all {len(domains)} domains. Put {{domain}} into it, "
                "or give a table with one pattern per domain.",
            )
        return dict.fromkeys(domains, value)
    for domain, pattern in value.items():
        if domain not in domains:
            raise table.error(
                f"{key}.{domain}",
                f"is for an unknown domain.{closest(domain, domains)} "
                f"`domains` at the top of the file lists: {', '.join(domains)}.",
            )
        if not isinstance(pattern, str):
            raise table.error(f"{key}.{domain}", f"is {pattern!r}, but must be text.")
    if required and (missing := [domain for domain in domains if domain not in value]):
        raise table.error(key, f"is missing for: {', '.join(missing)}. Give every domain a pattern.")
    return dict(value)


def _images(table: TomlTable, pattern: str, rows: _Rows, domain: str, camera: str) -> ImageSource:
    key = table.name("images")
    if not is_per_frame(pattern) and not is_glob(pattern):
        path = table.path(expand(pattern, key, domain=domain, camera=camera))
        if path.suffix.lower() not in SUFFIXES:
            raise table.error(
                "images",
                f"is {pattern!r}, which is the same for every frame. Put {{frame}} into it, "
                f"or name a video ({', '.join(SUFFIXES)}).",
            )
        return Video(path, rows.video_frames)
    files = frame_files(table.file.parent, pattern, key, frame_ids=rows.frame_ids, domain=domain, camera=camera)
    _check_present(key, files, rows.frame_ids)
    return ImageFiles(files)


def _masks(
    table: TomlTable, pattern: str, rows: _Rows, *, domain: str, camera: str, sparse: bool
) -> tuple[Path | None, ...]:
    key = table.name("masks")
    if not is_per_frame(pattern) and not is_glob(pattern):
        raise table.error("masks", f"is {pattern!r}, which is the same for every frame. Put {{frame}} into it.")
    files = frame_files(table.file.parent, pattern, key, frame_ids=rows.frame_ids, domain=domain, camera=camera)
    if sparse and any(file.is_file() for file in files):
        return tuple(file if file.is_file() else None for file in files)
    _check_present(key, files, rows.frame_ids, " If only some frames have masks, set sparse_masks = true.")
    return files


def _check_present(key: str, files: tuple[Path, ...], frame_ids: tuple[str, ...], hint: str = "") -> None:
    missing = [(file, frame_id) for file, frame_id in zip(files, frame_ids, strict=True) if not file.is_file()]
    if missing:
        shown = ", ".join(f"{file} (frame {frame_id})" for file, frame_id in missing[:_SHOWN_MISSING])
        rest = f" and {len(missing) - _SHOWN_MISSING} more" if len(missing) > _SHOWN_MISSING else ""
        raise SequenceError(
            f"{key}: {len(missing)} of {len(files)} files are missing: {shown}{rest}. The kinematics table has "
            f"{len(files)} rows and every row needs its file: put them back, correct the pattern, or remove the rows."
            f"{hint}"
        )
