"""Files as laboratories have them: imported with the right values, or a question that an option answers."""

import json
from collections.abc import Callable
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab_robots import PANDA, SO101, write_urdf
from recordings import START, T_CAMERA_BASE, BagKind, image, joints_at, pose_of, write_bag, write_images
from test_carts_layouts import cts
from test_datasets import surgpose
from test_lerobot import dataset, write_parquet
from test_surgsync import clip, episode
from videos import write_video

from carts_core.cli import main
from carts_core.errors import CartsError
from carts_core.model.psm_kinematics import JOINT_NAMES, forward
from carts_core.recording import Sequence
from carts_core.recording.importing.found import FoundRecording
from carts_core.recording.importing.importer import find, import_recording
from carts_core.settings.interchange import ImportOptions

FRAMES = 8
RATE = 4.0
ALPHABETICAL: list[str] = sorted(JOINT_NAMES)
Check = Callable[[FoundRecording], None]


def table(path: Path, columns: dict[str, Any], delimiter: str = ",", end: str = "\n") -> Path:
    """A text file of columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [list(columns), *zip(*columns.values(), strict=True)]
    path.write_text(end.join(delimiter.join(map(str, row)) for row in rows) + end, encoding="utf-8", newline="")
    return path


def joints(times: np.ndarray, names: Rows[str] = JOINT_NAMES) -> dict[str, np.ndarray]:
    """A column for each joint, in the order of `names`."""
    values = joints_at(times)
    return {name: values[:, JOINT_NAMES.index(name)] for name in names}


def frames(folder: Path, name: str = "{:03d}.png", count: int = FRAMES, first: int = 1) -> np.ndarray:
    """Images at 4 a second; gives their times [s]."""
    write_images(folder, count + first, name)
    for number in range(first):
        (folder / name.format(number)).unlink()
    return np.arange(count) / RATE


def measured(found: FoundRecording, arm: int = 0) -> np.ndarray:
    """The joint positions of an arm at every frame, as the sequence has them."""
    own = found.arms[arm]
    assert own.values is not None
    if own.times is None:
        return own.values
    assert found.frame_times is not None
    times = found.frame_times + found.time_offset
    return np.stack([np.interp(times, own.times, column) for column in own.values.T], 1)


def is_motion(found: FoundRecording, times: np.ndarray, tolerance: float = 1e-6) -> None:
    assert len(found.frame_ids) == len(times)
    assert np.abs(measured(found)[:, :6] - joints_at(times)).max() < tolerance


def says(found: FoundRecording, *words: str) -> None:
    text = " | ".join(f"{note.kind}: {note}" for note in found.notes)
    for word in words:
        assert word in text, text


# How rows meet images.


def index_beside_times(folder: Path) -> dict:
    """Rows at 100 Hz with a column that counts them; images at 4 Hz that are numbered from 1."""
    frames(folder / "images")
    times = np.arange(400) / 100
    table(folder / "log.csv", {"index": np.arange(1, 401), "time": times, **joints(times)})
    return {"frame_rate": RATE}


def index_without_rate(folder: Path) -> dict:
    index_beside_times(folder)
    return {}


def index_that_is_meant(folder: Path) -> dict:
    index_beside_times(folder)
    return {"columns": {"frame": "index"}}


def file_names_of_one_side(folder: Path) -> dict:
    """30 left and 27 right images, and a column of names that is called like no other."""
    for side, count in (("left", FRAMES), ("right", FRAMES - 3)):
        frames(folder / side, "{:03d}.jpg", count)
    names = [f"{number:03d}.jpg" for number in range(1, FRAMES + 1)]
    table(folder / "log.csv", {"pic": names, **joints(np.arange(FRAMES) / RATE)})
    return {}


def file_names(name: Callable[[int], str], image_name: str = "frame_{:04d}.png") -> Callable[[Path], dict]:
    """Rows in another order than the images, each with the name of its image."""

    def write(folder: Path) -> dict:
        times = frames(folder / "images", image_name)
        order = np.random.default_rng(1).permutation(FRAMES)
        names = [name(int(number) + 1) for number in order]
        table(folder / "log.csv", {"path": names, **joints(times[order])})
        return {}

    return write


def counted_from(first: int, image_first: int = 0, column: str = "frame") -> Callable[[Path], dict]:
    def write(folder: Path) -> dict:
        times = frames(folder / "images", first=image_first)
        table(folder / "log.csv", {column: np.arange(FRAMES) + first, **joints(times)})
        return {}

    return write


def video_counted_from_one(folder: Path) -> dict:
    write_video(folder / "scope.mp4", [image(number) for number in range(FRAMES)], int(RATE))
    table(folder / "log.csv", {"frame": np.arange(FRAMES) + 1, **joints(np.arange(FRAMES) / RATE)})
    return {}


def video_of_another_rate(folder: Path) -> dict:
    """One row per image, at 4 Hz, and a video with a nominal rate of 25 images/s."""
    write_video(folder / "scope.mp4", [image(number) for number in range(FRAMES)], 25)
    times = np.arange(FRAMES) / RATE
    table(folder / "log.csv", {"time": times, **joints(times)})
    return {}


def two_rows_for_each(folder: Path) -> dict:
    """The second row of each image is of another time."""
    times = frames(folder / "images")
    twice = np.stack([times, times + 0.1], 1).reshape(-1)
    table(folder / "log.csv", {"image": np.repeat(np.arange(FRAMES) + 1, 2), **joints(twice)})
    return {}


def more_rows_without_times(folder: Path) -> dict:
    frames(folder / "images")
    table(folder / "log.csv", joints(np.arange(2 * FRAMES) / RATE))
    return {}


def rows_of_known_rate(folder: Path) -> dict:
    """Images and rows without times, at rates of 4/s and 100/s."""
    frames(folder / "images")
    table(folder / "log.csv", joints(np.arange(0, FRAMES / RATE, 0.01)))
    return {"frame_rate": RATE, "row_rate": 100.0}


def fewer_rows_with_names(folder: Path) -> dict:
    times = frames(folder / "images")
    table(folder / "log.csv", {"frame": np.arange(FRAMES - 2) + 1, **joints(times[:-2])})
    return {}


def timed(scale: float = 1.0, offset: float = 0.0, change: Callable[[np.ndarray], np.ndarray] = lambda t: t):
    """Rows of 100 Hz whose times are in any unit, and images of 4 Hz."""

    def write(folder: Path) -> dict:
        frames(folder / "images")
        times = change(np.arange(-20, 300) / 100)
        stamps = [f"{(time + offset) * scale:.6f}" for time in times]
        table(folder / "log.csv", {"t": stamps, **joints(times)})
        return {"frame_rate": RATE}

    return write


def slow_log(folder: Path) -> dict:
    """A row a second, whose steps of 1 could be milliseconds."""
    frames(folder / "images", count=30)
    times = np.arange(0.0, 9.0)
    table(folder / "log.csv", {"time": times.astype(int), **joints(times / 100)})
    return {"frame_rate": RATE}


def doubled(times: np.ndarray) -> np.ndarray:
    return np.repeat(times, 2)


def jittered(times: np.ndarray) -> np.ndarray:
    return np.sort(times + np.random.default_rng(0).normal(0, 0.002, len(times)))


def gapped(times: np.ndarray) -> np.ndarray:
    return times[(times < 0.6) | (times > 0.9)]


def dates(folder: Path) -> dict:
    frames(folder / "images")
    times = np.arange(300) / 100
    stamps = [str(np.datetime64("2026-11-27T13:00:00", "us") + np.timedelta64(round(1e6 * t), "us")) for t in times]
    table(folder / "log.csv", {"when": [f"{stamp}Z" for stamp in stamps], **joints(times)})
    return {"frame_rate": RATE}


def gap_in_lerobot(folder: Path) -> dict:
    path = dataset(folder)
    times = np.array([0, 1, 2, 3]) / 30 + np.array([0, 0, 0.5, 0.5])
    write_parquet(
        path / "data/chunk-000/episode_000000.parquet",
        {
            "observation.state": [[*pose, 0.3] for pose in _poses(times)],
            "timestamp": times.astype(np.float32),
            "frame_index": list(range(4)),
        },
    )
    return {}


def _poses(times: np.ndarray) -> list[list[float]]:
    return [pose_of(T) for T in forward(joints_at(times))]


def two_arms(folder: Path) -> dict:
    """Two files without header, one for each arm."""
    times = frames(folder / "images")
    for number in (1, 2):
        np.savetxt(folder / f"psm{number}.csv", joints_at(times + number), delimiter=",")
    return {}


def two_arms_of_other_length(folder: Path) -> dict:
    frames(folder / "images")
    for number in (1, 2):
        np.savetxt(folder / f"psm{number}.csv", joints_at(np.arange(FRAMES - 3) / RATE), delimiter=",")
    return {}


def both_arms(found: FoundRecording) -> None:
    assert [arm.name for arm in found.arms] == ["PSM1", "PSM2"]
    for number in (0, 1):
        assert np.abs(measured(found, number) - joints_at(np.arange(FRAMES) / RATE + number + 1)).max() < 1e-9


def of_the_log(start: float = 0.0) -> Check:
    return lambda found: is_motion(found, start + np.arange(FRAMES) / RATE, 2e-4)


def of_each_row(*words: str) -> Check:
    def check(found: FoundRecording) -> None:
        is_motion(found, np.arange(FRAMES) / RATE)
        says(found, *words)

    return check


def frames_of_one_side(found: FoundRecording) -> None:
    is_motion(found, np.arange(FRAMES) / RATE)
    says(found, "warning: right: 3 of 8 frames have no image of this camera", "006, 007, 008", "by column 'pic'")


def with_a_gap(found: FoundRecording) -> None:
    assert found.frame_times is not None
    assert np.diff(found.frame_times) == pytest.approx([1 / 30, 1 / 30 + 0.5, 1 / 30], abs=1e-6)
    assert np.abs(measured(found)[:, :6] - joints_at(found.frame_times)).max() < 1e-5
    says(found, "warning: the column timestamp deviates by up to 0.500 s from a constant rate of 30 images/s")


def without_gap(found: FoundRecording) -> None:
    assert found.frame_times is not None and len(found.frame_ids) == FRAMES - 1
    says(found, "1 gap of up to 0.32 s in the log", "left out 1 of 8 frames")


def slowly(found: FoundRecording) -> None:
    assert not any("gap" in str(note) for note in found.notes)
    assert found.arms[0].times is not None and np.diff(found.arms[0].times) == pytest.approx(1.0)


ROWS: dict[str, tuple[Callable[[Path], dict], Check | str]] = {
    "L18 times and a rate come before an index": (index_beside_times, of_the_log()),
    "L18 an index that may count rows": (index_without_rate, "column 'index' counts 400 rows.*--frame-rate.*--columns"),
    "an index that is said to be the images'": (
        index_that_is_meant,
        lambda found: is_motion(found, np.arange(8) / 100),
    ),
    "L14 names of files under any header, one side shorter": (file_names_of_one_side, frames_of_one_side),
    "names of files": (file_names(lambda n: f"frame_{n:04d}.png"), of_each_row("by column 'path'")),
    "names with folders": (file_names(lambda n: f"D:\\data\\left\\frame_{n:04d}.png"), of_each_row()),
    "names with another suffix": (file_names(lambda n: f"./raw/frame_{n:04d}.tiff"), of_each_row()),
    "names without leading zeros": (file_names(lambda n: f"img {n}.png", "img {}.png"), of_each_row()),
    "names with other numbers": (file_names(lambda n: f"run2_cam1_{n}.png", "run2_cam1_{}.png"), of_each_row()),
    "counted from 1, images from 0": (counted_from(1), of_each_row("warning: log.csv: column 'frame' counts from 1")),
    "counted from 0, images from 1": (
        counted_from(0, 1),
        of_each_row("warning: log.csv: column 'frame' counts from 0"),
    ),
    "counted as the images": (counted_from(1, 1, "img"), of_each_row("by column 'img'")),
    "frames of a video from 1": (video_counted_from_one, of_each_row("column 'frame' counts from 1")),
    "a video of another rate than its rows": (video_of_another_rate, of_each_row("by the order of rows and images")),
    "two rows for each image": (two_rows_for_each, of_each_row("8 rows of an image that already has a row")),
    "twice as many rows": (more_rows_without_times, "8 images and log.csv has 16 rows, and the table has no times"),
    "rows of a known rate": (rows_of_known_rate, of_the_log()),
    "fewer rows": (fewer_rows_with_names, lambda found: is_motion(found, np.arange(FRAMES - 2) / RATE)),
    "seconds": (timed(), of_the_log()),
    "milliseconds": (timed(1e3), of_the_log()),
    "microseconds": (timed(1e6), of_the_log()),
    "nanoseconds": (timed(1e9), of_the_log()),
    "a row a second": (slow_log, slowly),
    "doubled times": (timed(change=doubled), of_the_log()),
    "jittered times": (timed(change=jittered), of_the_log()),
    "a gap in the log": (timed(change=gapped), without_gap),
    "times that go back": (
        timed(change=lambda times: times[::-1]),
        "column 't': times decrease from 2.99 to 2.98 in row 2",
    ),
    "L26 dates": (dates, of_the_log()),
    "L11 a gap in a LeRobot episode": (gap_in_lerobot, with_a_gap),
    "L40 two arms in two files without header": (two_arms, both_arms),
    "L40 two arms with fewer rows": (two_arms_of_other_length, "psm1.csv has 5 rows.*Other tables: psm2.csv, 5 rows"),
}


# How tables are written.


def written(change: Callable[[str], str], name: str = "log.csv") -> Callable[[Path], dict]:
    """A table of joints with a column of images, whose text is changed."""

    def write(folder: Path) -> dict:
        times = frames(folder / "images")
        path = table(folder / name, {"image": np.arange(FRAMES) + 1, **joints(times)})
        text = change(path.read_text())
        path.write_bytes(text.encode())
        return {}

    return write


def units_row(text: str) -> str:
    header, rest = text.split("\n", 1)
    return f"{header}\n-,rad,rad,m,rad,rad,rad\n{rest}"


def degrees_row(text: str) -> str:
    lines = [line.split(",") for line in units_row(text).splitlines()]
    scaled = [
        [row[0], *(f"{float(v) * (1e3 if i == 2 else 180 / np.pi):.9f}" for i, v in enumerate(row[1:]))]
        for row in lines[2:]
    ]
    return "\n".join(",".join(row) for row in [lines[0], ["", "deg", "deg", "mm", "deg", "deg", "deg"], *scaled])


WRITTEN: dict[str, tuple[Callable[[Path], dict], Check | str]] = {
    "a byte order mark": (
        written(lambda text: f"\ufeff{text}"),
        of_each_row("joint positions are read from yaw, pitch"),
    ),
    "L16 semicolons and decimal commas": (
        written(lambda text: text.replace(",", ";").replace(".", ",")),
        of_each_row("decimal commas are read as decimal points"),
    ),
    "tabs": (written(lambda text: text.replace(",", "\t"), "log.tsv"), of_each_row()),
    "blanks": (written(lambda text: text.replace(",", "  "), "log.txt"), of_each_row()),
    "CRLF and blank lines": (written(lambda text: text.replace("\n", "\r\n\r\n")), of_each_row()),
    "quoted headers": (
        written(
            lambda text: (
                ",".join(f'"{name}"' for name in text.split("\n")[0].split(",")) + "\n" + text.split("\n", 1)[1]
            )
        ),
        of_each_row(),
    ),
    "L26 a comma at the end of the rows": (
        written(
            lambda text: "\n".join(line + ("," if number else "") for number, line in enumerate(text.splitlines()))
        ),
        of_each_row("an empty cell at the end of its rows is ignored"),
    ),
    "a comma at the end of all lines": (written(lambda text: text.replace("\n", ",\n")), of_each_row()),
    "L16 a row of units": (written(units_row), of_each_row("line 2 has units: image -, yaw rad")),
    "a row of units that are degrees": (written(degrees_row), of_each_row("angles are in deg, lengths in mm")),
    "L26 a cell that is no number": (
        written(lambda text: text.replace("\n3,", "\n3,off ")),
        r"column 'yaw' has cells that are not numbers: 1 of 8, the first in line 4: 'off ",
    ),
    "a ragged row": (
        written(lambda text: text.replace("\n3,", "\n3,0,0,")),
        r"log.csv cannot be read \(line 4 has",
    ),
}


# Joints against the limits of the robot.


def joint_table(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], **options: Any):
    def write(folder: Path) -> dict:
        times = frames(folder / "images")
        table(folder / "log.csv", change(joints(times)))
        return options

    return write


def negative_insertion(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {**columns, "insertion": -columns["insertion"]}


def scaled(angle: float, length: float):
    return lambda columns: {name: v * (length if name == "insertion" else angle) for name, v in columns.items()}


def swapped(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {**columns, "insertion": columns["roll"], "roll": columns["insertion"]}


def jaw_in_degrees(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {**columns, "jaw": np.full(FRAMES, 5.4)}


def so101_state(folder: Path, **options: Any) -> dict:
    """States of -8 to 8, out of -100 to 100."""
    path = dataset(folder)
    names = [f"{name}.pos" for name in SO101]
    info = json.loads((path / "meta/info.json").read_text())
    info["features"]["observation.state"] = {"dtype": "float32", "shape": [6], "names": names}
    (path / "meta/info.json").write_text(json.dumps(info))
    state = [[8.0, -8.0, 4.0, 0.0, 2.0, 50.0]] * 4
    write_parquet(path / "data/chunk-000/episode_000000.parquet", {"observation.state": state})
    return {"robot": {"SO101": str(write_urdf(folder.parent / "so101.urdf", SO101))}, **options}


def shares_of_the_range(found: FoundRecording) -> None:
    values = measured(found)
    assert found.arms[0].name == "SO101" and found.arms[0].columns == tuple(SO101)
    assert values[0, :5] == pytest.approx([0.1536, -0.1536, 0.0768, 0, 0.0384]) and values[0, 5] == pytest.approx(0.0)


def panda_log(folder: Path, **options: Any) -> dict:
    times = frames(folder / "images")
    values = 0.3 * np.sin(times[:, None] + np.arange(7)) - 0.4
    table(folder / "log.csv", {f"panda_joint{n + 1}": values[:, n] for n in reversed(range(7))})
    return options


def panda_with_robot(folder: Path) -> dict:
    options = panda_log(folder)
    return {**options, "robot": {"panda": str(write_urdf(folder.parent / "panda.urdf", PANDA))}}


def all_of_the_panda(found: FoundRecording) -> None:
    assert found.arms[0].name == "panda" and found.arms[0].columns == tuple(PANDA)
    expected = 0.3 * np.sin((np.arange(FRAMES) / RATE)[:, None] + np.arange(7)) - 0.4
    assert np.abs(measured(found) - expected).max() < 1e-9


def named_columns(folder: Path) -> dict:
    """Columns name_0.. and position_0.. of messages whose names are in alphabetical order."""
    times = frames(folder / "images")
    columns: dict[str, Any] = {"frame": np.arange(FRAMES) + 1}
    for number, (name, values) in enumerate(joints(times, ALPHABETICAL).items()):
        columns |= {f"name_{number}": [name] * FRAMES, f"position_{number}": values}
    table(folder / "log.csv", columns)
    return {}


JOINTS: dict[str, tuple[Callable[[Path], dict], Check | str]] = {
    "L20 negative insertion": (
        joint_table(negative_insertion),
        lambda found: says(
            found, "warning: PSM1: positions of insertion range from -0.1", "the opposite sign", "--flip insertion"
        ),
    ),
    "negative insertion, turned": (joint_table(negative_insertion, flip=("insertion",)), of_each_row()),
    "L20 a jaw of 5.4 rad": (
        joint_table(jaw_in_degrees),
        lambda found: says(
            found, "positions of jaw range from 5.4 to 5.4 rad", "deg (interpreted as 0.0942", "--units jaw deg"
        ),
    ),
    "a jaw in degrees, said": (
        joint_table(jaw_in_degrees, units={"jaw": "deg"}),
        lambda found: np.testing.assert_allclose(measured(found)[:, 6], np.radians(5.4)),
    ),
    "degrees and millimetres": (joint_table(scaled(180 / np.pi, 1e3)), of_each_row("angles are in deg, lengths in mm")),
    "degrees and metres": (joint_table(scaled(180 / np.pi, 1.0)), of_each_row("angles are in deg, lengths in m ")),
    "decimetres": (joint_table(scaled(1.0, 10.0)), r"insertion is ambiguous.*: dm \(0.1.*--length-unit"),
    "decimetres, said": (joint_table(scaled(1.0, 10.0), length_unit="dm"), of_each_row()),
    "swapped columns": (
        joint_table(swapped),
        "insertion is ambiguous.*Or choose other columns: .*exchanged columns of insertion and roll would fit",
    ),
    "swapped columns, said to be metres": (
        joint_table(swapped, length_unit="m"),
        lambda found: says(
            found, "warning: PSM1: positions of insertion range from", "exchanged columns of insertion and roll"
        ),
    ),
    "L19 names beside positions": (named_columns, of_each_row()),
    "L21 states of a motor out of 100": (so101_state, "unit of the angles is not known.*deg, percent.*--angle-unit"),
    "L21 states of a motor, said": (lambda path: so101_state(path, angle_unit="percent"), shares_of_the_range),
    "L35 another robot": (panda_log, r"panda_joint7 \(.*neither six joints.*--robot NAME FILE.urdf"),
    "L35 another robot, given": (panda_with_robot, all_of_the_panda),
}


@pytest.mark.parametrize("name", [*ROWS, *WRITTEN, *JOINTS])
def test_a_file_of_a_laboratory_is_right_or_a_question(tmp_path: Path, name: str) -> None:
    write, expected = {**ROWS, **WRITTEN, **JOINTS}[name]
    folder = tmp_path / "rec"
    options = ImportOptions(**write(folder))
    if isinstance(expected, str):
        with pytest.raises(CartsError, match=f"(?s){expected}"):
            find(folder, options)
    else:
        expected(find(folder, options))


# Names, offsets and poses of other sources.


def alphabetical_names(path: Path) -> None:
    """Give the joints of a raw clip of SurgSync names in another order."""
    for file in (path / "kinematic/PSM1").iterdir():
        content = json.loads(file.read_text())
        state = content[0]["arm"]["measured_data"]["measured_js"]
        state["position"] = [state["position"][JOINT_NAMES.index(name)] for name in ALPHABETICAL]
        state["name"] = ALPHABETICAL
        file.write_text(json.dumps(content))


def test_joint_states_are_read_by_their_names_in_bags_and_clips(tmp_path: Path) -> None:
    names = tuple(f"outer_{name}" for name in ALPHABETICAL)
    found = find(write_bag(tmp_path / "bag", BagKind(names=names, cameras=("left",))))
    assert found.frame_times is not None
    assert np.abs(measured(found)[:, :6] - joints_at(found.frame_times - START * 1e-9)).max() < 1e-4
    says(found, "PSM1: joint positions are in the order outer_insertion, outer_pitch")
    strange = find(write_bag(tmp_path / "other", BagKind(names=tuple("abcdef"), cameras=("left",))))
    says(strange, "warning: PSM1: a, b, c, d, e, f are not joints of a PSM")
    mixed = ("pitch", "yaw", "insertion", "roll", "wrist_pitch", "q")
    with pytest.raises(CartsError, match=r"names pitch, yaw, .*by name or order"):
        find(write_bag(tmp_path / "mixed", BagKind(names=mixed, cameras=("left",))))
    path = clip(tmp_path / "clip")
    before = measured(find(path))
    alphabetical_names(path)
    assert np.array_equal(measured(find(path)), before)


def test_poses_of_another_tool_point_are_brought_to_the_tip_and_said(tmp_path: Path) -> None:
    found = find(write_bag(tmp_path / "bag", BagKind(tool_point=0.0102, cameras=("left",), local=False)))
    T = found.arms[0].T_world_base
    assert T is not None and np.abs(T - T_CAMERA_BASE).max() < 2e-5
    says(found, "poses refer to a point at 0.0, 0.0, 10.2 mm from the tip", "--tool-point")
    poses_alone = BagKind(tool_point=0.0102, joints=False, cameras=("left",))
    found = find(write_bag(tmp_path / "poses", poses_alone), ImportOptions(tool_point=0.0102))
    assert found.frame_times is not None
    assert np.abs(measured(found)[:, :6] - joints_at(found.frame_times - START * 1e-9)).max() < 1e-3


@pytest.mark.parametrize("make", [surgpose, clip, episode, cts], ids=["surgpose", "clip", "episode", "cts"])
def test_rows_of_images_get_times_for_a_time_offset(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    path = make(tmp_path / "rec")
    at_once = find(path, ImportOptions(frame_rate=30))
    assert at_once.frame_times is not None and np.diff(at_once.frame_times) == pytest.approx(1 / 30)
    file, later = import_recording(path, tmp_path / "out", ImportOptions(frame_rate=30, time_offset=1 / 30))
    assert np.abs(measured(later)[0] - measured(at_once)[1]).max() < 1e-6
    assert Sequence.open(file).checked_matching().time_offset == pytest.approx(1 / 30)


# Options, places and rights.


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": {"PSM7": "/nonexistent.urdf"}}, "rec has no arm 'PSM7'. It has: PSM1. Correct --robot"),
        ({"base": {"PSM9": Path("x.json")}}, "rec has no arm 'PSM9'. It has: PSM1. Correct --base"),
        ({"calibration": {"middle": Path("y.yaml")}}, "no camera 'middle'. It has: camera. Correct --calibration"),
        ({"arms": {"PSM1": "nose", "PSM2": "ear"}}, "rec has no arm 'PSM2'.*Correct --arms"),
        ({"columns": {"yawn": "yaw"}}, "yawn is not a known meaning of a column. Allowed are: yaw"),
        ({"flip": ("knee",)}, "knee is not a joint.*--flip"),
        ({"units": {"yaw": "mm"}}, "unit of yaw is mm; allowed: rad.*--units"),
        ({"time_offset": 0.1}, "a time offset needs times.*--frame-rate"),
        ({"robot": {"PSM1": "none.urdf"}}, "robot none.urdf of PSM1 is missing"),
    ],
)
def test_options_for_unknown_names_list_the_known_ones(tmp_path: Path, options: dict, message: str) -> None:
    counted_from(1, 1)(tmp_path / "rec")
    with pytest.raises(CartsError, match=message):
        find(tmp_path / "rec", ImportOptions(**options))


def test_options_that_a_kind_of_recording_does_not_use_are_refused(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", BagKind(cameras=("left",), frames=2))
    with pytest.raises(CartsError, match=r"kinematics is not used for a ROS 1 or ROS 2 bag.*--kinematics"):
        find(bag, ImportOptions(kinematics=Path("log.csv")))
    with pytest.raises(CartsError, match="a frame rate is not used, since the images of the bag have times"):
        find(bag, ImportOptions(frame_rate=30))


def test_paths_are_seen_from_the_working_directory_and_else_from_the_recording(tmp_path: Path, monkeypatch) -> None:
    file_names(lambda n: f"frame_{n:04d}.png")(tmp_path / "rec")
    frames(tmp_path / "here/other", count=3)
    monkeypatch.chdir(tmp_path / "here")
    for place, count in (("other", 3), ("images", FRAMES)):
        found = find(tmp_path / "rec", ImportOptions(images={"camera": place}, kinematics=Path("none")))
        assert len(found.frame_ids) == count
    table(tmp_path / "here/mine.csv", {"frame": [1, 2, 3], **joints(np.arange(3) / RATE)})
    options = ImportOptions(images={"camera": "other"}, kinematics=Path("mine.csv"))
    assert np.abs(measured(find(tmp_path / "rec", options)) - joints_at(np.arange(3) / RATE)).max() < 1e-9


def test_leftovers_links_rights_and_names_do_not_matter(tmp_path: Path, monkeypatch) -> None:
    """Hidden files, Thumbs.db, a link to a folder, no right to write, blanks and accents in all names."""
    folder = tmp_path / "Aufnahme für Zoë 1"
    counted_from(1, 1)(folder)
    for name in ("images/._001.png", "images/Thumbs.db", "._log.csv"):
        (folder / name).write_bytes(b"\x00\x05\x16\x07")
    (folder / "images").rename(tmp_path / "sehr weit weg")
    (folder / "Bilder é").symlink_to(tmp_path / "sehr weit weg")
    monkeypatch.chdir(tmp_path)
    folder.chmod(0o555)
    main(["import", str(folder)])
    sequence = Sequence.open(tmp_path / f"{folder.name}_sequence/sequence.toml")
    assert len(sequence) == FRAMES and sequence.frame(7).images["camera"].shape == (72, 96, 3)
    assert np.abs(sequence.measured["PSM1"][:, :6] - joints_at(np.arange(FRAMES) / RATE)).max() < 1e-8


@pytest.mark.parametrize(
    ("change", "reading"),
    [
        (lambda T: T, ""),
        (np.linalg.inv, "its inverse"),
        (lambda T: T * np.array([[1, 1, 1, 1e3]] * 3 + [[1, 1, 1, 1]]), "millimetres for metres"),
    ],
    ids=["right", "inverse", "millimetres"],
)
def test_base_frames_out_of_view_are_said(
    tmp_path: Path, change: Callable[[np.ndarray], np.ndarray], reading: str
) -> None:
    counted_from(1, 1)(tmp_path / "rec")
    in_view = find(tmp_path / "rec").arms[0].T_world_base
    assert in_view is not None
    file = tmp_path / "PSM1-registration-open-cv.json"
    file.write_text(json.dumps({"base-frame": {"reference-frame": "camera", "transform": change(in_view).tolist()}}))
    found = find(tmp_path / "rec", ImportOptions(base={"PSM1": file}))
    if reading:
        says(found, "outside the view", reading)
    else:
        assert not any("outside the view" in str(note) for note in found.notes)


def test_a_pair_whose_sides_are_swapped_is_said(tmp_path: Path) -> None:
    path = surgpose(tmp_path / "000000")
    ini = path / "StereoCalibrationDVRK.ini"
    ini.write_text(ini.read_text().replace("T_0=-5.0", "T_0=5.0"))
    says(find(path), "warning: the right camera is 5.0 mm to the left of the left camera")


def test_a_table_that_is_not_understood_is_shown_with_its_values_and_can_be_left_out(tmp_path: Path) -> None:
    times = frames(tmp_path / "rec/images")
    columns = {f"{word} thing": values for word, values in zip("abcdef", joints_at(times).T, strict=True)}
    table(tmp_path / "rec/log.csv", columns)
    with pytest.raises(CartsError, match=r"log.csv has 8 rows with the columns a thing \(0.1\), .*--kinematics none"):
        find(tmp_path / "rec")
    assert find(tmp_path / "rec", ImportOptions(kinematics=Path("none"))).kind == "images without kinematics"
    chosen: dict[str, str] = dict(zip(JOINT_NAMES, columns, strict=True))
    assert np.abs(measured(find(tmp_path / "rec", ImportOptions(columns=chosen))) - joints_at(times)).max() < 1e-9


def test_a_sequence_file_never_reads_shares_of_a_range_as_radians(tmp_path: Path) -> None:
    """States of -8 to 8 out of -100 to 100, without and with their unit."""
    frames(tmp_path / "images")
    write_urdf(tmp_path / "so101.urdf", SO101)
    values = {name: np.linspace(-8.0, 8.0, FRAMES) for name in SO101}
    table(tmp_path / "log.csv", {"frame": [f"{n + 1:03d}" for n in range(FRAMES)], **values})
    names = "".join(f'{name} = "{name}"\n' for name in SO101)
    text = (
        'format = "carts-sequence/1"\n[kinematics]\ntable = "log.csv"\n[[arms]]\nname = "arm"\nrobot = "so101.urdf"\n'
        f'UNIT[arms.joints]\n{names}[[cameras]]\nname = "left"\nsize = [96, 72]\nimages = "images/{{frame}}.png"\n'
        "K = { fx = 100.0, fy = 100.0, cx = 48.0, cy = 36.0 }\npixel_center = 0.5\n"
    )
    path = tmp_path / "sequence.toml"
    path.write_text(text.replace("UNIT", ""))
    with pytest.raises(
        CartsError, match=r'read in rad, .* -8 to 8 rad, .* -1.92 to 1.92.*angle_unit = "deg" or "percent"'
    ):
        Sequence.open(path)
    path.write_text(text.replace("UNIT", 'angle_unit = "percent"\n'))
    assert np.abs(Sequence.open(path).measured["arm"][-1] - 0.08 * 1.92).max() < 1e-9
