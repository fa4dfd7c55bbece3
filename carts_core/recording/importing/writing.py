"""Writing of a sequence file with comments, and of its tables."""

import io
import json
import os
import re
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import CartsError, SequenceError
from ...files import MARKER, OutputPath, file_name, published, write_bytes, write_text
from ...model.instruments import SCHEME, robot_file
from .. import Sequence
from ..kinematics_table import joints_of
from ..matching import ORIENTATION, POSITION
from .found import FoundArm, FoundCamera, FoundRecording
from .placing import MAX_GAP

FRAMES = "frames.csv"
MOTION = "endoscope.csv"
_HANDLE = "frame"


def write_sequence(recording: FoundRecording, folder: Path, *, overwrite: bool = False) -> Path:
    """Write FOLDER/sequence.toml with its tables, whole or not at all; images and videos are not copied.

    Args:
        recording: completed (`placing.completed`).
        folder: output folder.
        overwrite: replace an earlier import.

    Returns:
        The sequence file.

    Raises:
        SequenceError: the content is not a valid sequence.
        OutputError: the folder is there, or cannot be written to.
    """
    with TemporaryDirectory() as trial:
        _write(recording, Path(trial), Path(trial))
        try:
            sequence = Sequence.open(Path(trial) / "sequence.toml")
            sequence.frame(0)
            sequence.frame(len(sequence) - 1)
        except CartsError as error:
            if trial not in str(error):
                raise
            raise SequenceError(_of_recording(str(error), trial, recording)) from error
    with published(folder, overwrite=overwrite) as draft:
        _write(recording, draft, folder.absolute())
        write_text(draft / MARKER, json.dumps({"format": "sequence", "source": recording.kind}))
    return folder / "sequence.toml"


def _of_recording(text: str, trial: str, recording: FoundRecording) -> str:
    """An error about temporary files, rephrased as one about the recording."""
    tables = {FRAMES: "", **{_table_of(arm): f" in the log of {arm.name}" for arm in recording.arms}}
    for table, where in tables.items():

        def place(match: re.Match[str], where: str = where) -> str:
            row = int(match[1]) - 2
            named = f"frame {recording.frame_ids[row]!r}" if not where and row < len(recording.frame_ids) else ""
            return f"{recording.name}: {named or f'row {row + 1}{where}'}"

        text = re.sub(rf"{re.escape(f'{trial}/{table}')},? line (\d+)", place, text)
        text = text.replace(f"{trial}/{table}", f"{recording.name}{where}")
    return text.replace(f"{trial}/sequence.toml", recording.name).replace(f"{trial}/", "")


def _write(recording: FoundRecording, target: Path | OutputPath, place: Path) -> None:
    """Write all files into `target`, with paths relative to `place`."""
    tables = _tables(recording)
    for name, content in tables.items():
        write_bytes(target / name, content)
    write_text(target / "sequence.toml", _toml(recording, place.resolve()))


def _tables(recording: FoundRecording) -> dict[str, bytes]:
    frame_columns: dict[str, list[str]] = {_HANDLE: list(recording.frame_ids)}
    start = _start(recording)
    if recording.frame_times is not None:
        frame_columns["timestamp"] = [f"{time:.9f}" for time in recording.frame_times - start]
    for camera in recording.cameras:
        if camera.numbers is not None:
            frame_columns[_column(camera)] = [str(int(number)) for number in camera.numbers]
    tables: dict[str, bytes] = {}
    for arm in recording.arms:
        if arm.values is None:
            continue
        if arm.times is None:
            if len(arm.values) != len(recording.frame_ids):
                raise SequenceError(
                    f"{arm.name} has {len(arm.values)} rows of joint positions for {len(recording.frame_ids)} images. "
                    "Each image needs its row: remove what is left over, or give both times."
                )
            for name, values in zip(arm.columns, arm.values.T, strict=True):
                frame_columns[f"{arm.name}.{name}"] = [f"{value:.9f}" for value in values]
        else:
            stream = io.BytesIO()
            rows = np.column_stack([arm.times - start, arm.values])
            np.savetxt(stream, rows, "%.9f", ",", header=",".join(["timestamp", *arm.columns]), comments="")
            tables[_table_of(arm)] = stream.getvalue()
    if _moves(recording):
        tables[MOTION] = _motion_table(recording, start)
    rows = zip(*frame_columns.values(), strict=True)
    lines = [",".join(frame_columns), *(",".join(cells) for cells in rows)]
    return {FRAMES: ("\n".join(lines) + "\n").encode(), **tables}


def _moves(recording: FoundRecording) -> bool:
    """Whether camera motion is written, which needs logs with times."""
    return recording.motion is not None and any(arm.times is not None for arm in recording.arms)


def _motion_table(recording: FoundRecording, start: float) -> bytes:
    assert recording.motion is not None
    Ts, stream = recording.motion.Ts_world_mount, io.BytesIO()
    rows = np.column_stack(
        [recording.motion.times - start, Ts[:, :3, 3], Rotation.from_matrix(Ts[:, :3, :3]).as_quat()]
    )
    np.savetxt(stream, rows, "%.9f", ",", header=",".join(["timestamp", *POSITION, *ORIENTATION]), comments="")
    return stream.getvalue()


def _start(recording: FoundRecording) -> float:
    return 0.0 if recording.frame_times is None else float(recording.frame_times.min())


def _table_of(arm: FoundArm) -> str:
    return f"{file_name(arm.name)}.csv"


def _column(camera: FoundCamera) -> str:
    return f"{camera.name}_{'ns' if camera.topic else 'frame'}"


def _toml(recording: FoundRecording, place: Path) -> str:
    timed = [arm for arm in recording.arms if arm.times is not None]
    lines = [
        f"# Made by carts import from {recording.kind}. Everything here may be edited: docs/sequence_format.md.",
        *(f"# {note.kind}: {_one_line(note.text)}" for note in recording.notes),
        "",
        'format = "carts-sequence/1"',
        f"name = {_text(recording.name)}",
    ]
    if recording.domains:
        lines.append(f"domains = {_text(list(recording.domains))}")
    if timed:
        start = _start(recording)
        lines += [
            "",
            "[frames]",
            f"table = {_text(FRAMES)}                  # times count from {start:.6f} s of the recording",
            f"time_offset = {recording.time_offset!r}  # [s] time in the log minus time of the image",
            f"max_gap = {MAX_GAP}",
            "",
            "[kinematics]",
            f"table = {_text(_table_of(timed[0]))}",
            'timestamp = "timestamp"',
        ]
    else:
        lines += ["", "[kinematics]", f"table = {_text(FRAMES)}                  # a row per frame"]
        if recording.frame_times is not None:
            lines.append('timestamp = "timestamp"')
    for arm in recording.arms:
        lines += _arm_lines(arm, place, bool(timed))
    for camera in recording.cameras:
        lines += _camera_lines(camera, place, _moves(recording))
    return "\n".join(lines) + "\n"


def _arm_lines(arm: FoundArm, place: Path, timed: bool) -> list[str]:
    builtin = arm.robot.startswith(SCHEME)
    urdf = robot_file(arm.robot).absolute()
    if not urdf.is_file():
        raise SequenceError(
            f"robot {arm.robot} of {arm.name} is missing. Give the path of a URDF (carts robot makes one)."
        )
    names = [joint.name for joint in joints_of(arm.robot)]
    has_jaw = "jaw" in names
    lines = [
        "",
        "[[arms]]",
        f"name = {_text(arm.name)}",
        f"robot = {_text(arm.robot if builtin else _relative(urdf, place))}",
        f"# The base frame is from {arm.base_from}.",
        *_matrix("T_world_base", arm.T_world_base),
    ]
    if timed and arm.times is not None:
        lines.append(f"table = {_text(_table_of(arm))}")
    if arm.beyond_limits:
        lines += ['angle_unit = "rad"   # Some are beyond the limits of the robot (see above).', 'length_unit = "m"']
    known = arm.columns if arm.values is not None else ()
    columns = [name for name in known if name != "jaw" or has_jaw]
    prefix = "" if arm.times is not None else f"{arm.name}."
    if columns:
        lines += ["", "[arms.joints]", *(f"{name} = {_text(prefix + name)}" for name in columns)]
    rest = [name for name in names if name not in known]
    if rest:
        lines += ["", "[arms.defaults]", *(f"{name} = 0.0" for name in rest)]
    return lines


def _camera_lines(camera: FoundCamera, place: Path, moves: bool) -> list[str]:
    assert camera.intrinsics is not None
    fx, fy, cx, cy = (float(value) for value in camera.intrinsics)
    images = _relative(camera.images, place)
    if camera.pattern:
        images = f"{images.replace('{', '{{').replace('}', '}}')}/{camera.pattern}"
    lines = [
        "",
        "[[cameras]]",
        f"name = {_text(camera.name)}",
        f"size = [{camera.size[0]}, {camera.size[1]}]",
        f"K = {{ fx = {fx!r}, fy = {fy!r}, cx = {cx!r}, cy = {cy!r} }}",
        f"pixel_center = {camera.pixel_center}",
    ]
    if any(camera.distortion):
        lines.append(f"distortion = {[float(value) for value in camera.distortion]}")
    lines.append(f"images = {_text(images)}")
    if camera.bits is not None:
        lines.append(f"bits = {camera.bits}")
    if camera.crop is not None:
        lines.append(f"crop = {list(camera.crop)}")
    if camera.topic:
        lines += [f"topic = {_text(camera.topic)}", f"message_time = {_text(_column(camera))}"]
    elif camera.numbers is not None:
        lines.append(f"video_frame = {_text(_column(camera))}")
    if moves:
        lines.append(f"motion = {_text(MOTION)}  # where the camera is, in the world that it is at the first image")
    if camera.masks:
        masks = Path(camera.masks)
        parent = _relative(masks.parent, place).replace("{{", "{").replace("}}", "}")
        lines.append(f"masks = {_text(f'{parent}/{masks.name}')}")
        if camera.sparse_masks:
            lines.append("sparse_masks = true")
    pose = np.eye(4) if camera.T_camera_world is None else camera.T_camera_world
    return [*lines, *_matrix("T_camera_world", pose)]


def _matrix(key: str, values: np.ndarray | None) -> list[str]:
    if values is None:
        return []
    # Adding 0 makes -0.0 a plain zero.
    rows = (np.round(values, 12) + 0.0).tolist()
    return [f"{key} = [", *(f"    {row}," for row in rows), "]"]


def _relative(path: Path, place: Path) -> str:
    return Path(os.path.relpath(path.absolute(), place)).as_posix()


def _text(value: object) -> str:
    """Text, or a list of texts, as TOML, whose strings are those of JSON."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _one_line(text: str) -> str:
    return " ".join(text.split())
