"""Errors of sequence files: each names the file, the location, the allowed values and a remedy."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from carts_core.errors import RobotError, SequenceError
from carts_core.recording import Sequence

Edit = Callable[[str], str]
MIRRORED = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]"


def line(key: str, new: str) -> Edit:
    """An edit that replaces the line `key = ...` by `new`."""

    def edit(text: str) -> str:
        edited, count = re.subn(rf"^{re.escape(key)} = .*$", lambda _: new, text, flags=re.MULTILINE)
        assert count >= 1
        return edited

    return edit


def error_of(path: Path, kind: type[Exception] = SequenceError) -> str:
    with pytest.raises(kind) as caught:
        Sequence.open(path)
    return str(caught.value)


@pytest.mark.parametrize(
    ("edit", "parts"),
    [
        (line("format", 'format = "carts-sequence/9"'), ["format is 'carts-sequence/9'", "carts-sequence/1"]),
        (line("format", ""), ["format is '(none)'", "carts-sequence/1"]),
        (line("domains", 'domain = ["regular"]'), ["domain is not a key", "Did you mean 'domains'"]),
        (line("domains", "domains = []"), ["domains is []", 'domains = ["regular", "smoke"]']),
        (line("table", 'tabel = "kinematics.csv"'), ["[kinematics]: table is missing", "Is 'tabel' a misspelling"]),
        (line("table", 'table = "other.csv"'), ["kinematics table", "other.csv is missing", "Correct the path"]),
        (line("timestamp", 'timestamp = "tome"'), ["no column 'tome'", "timestamp names", "Did you mean 'time'"]),
        (line("frame_id", 'frame_id = "001"'), ["frame_id is '001'", "{frame:03d}"]),
        (line("robot", 'robot = "builtin:psm"'), ["no robot 'builtin:psm'", "Did you mean 'builtin:psm_lnd"]),
        (line("yaw", 'yaww = "yaw"'), ["[arms.joints]", "yaww is not a joint", "Did you mean 'yaw'", "insertion"]),
        (line("yaw", ""), ["[arms.joints]: yaw is missing", "yaw = 0.0", "[rad]"]),
        (
            line("yaw", 'yaw = "yow"'),
            ["kinematics.csv has no column 'yow'", "[arms.joints] yaw names", "Did you mean 'yaw'"],
        ),
        (line("yaw", 'yaw = { column = "yaw", unit = "mm" }'), ["unit is 'mm', but must be one of: rad, deg"]),
        (line("jaw", 'jaw = "jaw"\n[arms.defaults]\njaw = 0.1'), ["jaw is given, but the joint also has a column"]),
        (line("size", "size = [96]"), ["'left': size is [96]", "[640, 480]"]),
        (line("K", "K = [[0, 0, 1], [0, 5, 1], [0, 0, 1]]"), ["'left'", "fx = 0", "must be positive"]),
        (line("K", "K = [1, 2, 3]"), ["K is [1, 2, 3]", "3 rows of 3 numbers", "fx = ..."]),
        (line("K", "K = [[5, 0, 0], [0, 5, 0], [1, 1, 1]]"), ["K is", "not transposed"]),
        (line("K", 'K = "calibration.json"'), ["K is 'calibration.json'", "file.json#name"]),
        (line("size", "size = [96, 72]\npixel_center = 1.0"), ["pixel_center is 1.0", "0.5", "0.0"]),
        (line("size", "size = [96, 72]\ndistortion = [0.1]"), ["'left'", "there are 1 distortion coefficients"]),
        (
            line("T_camera_world", f"T_camera_world = {MIRRORED}"),
            ["'left': T_camera_world is a reflection", "must be +1"],
        ),
        (
            line("T_camera_world", f"T_camera_world = {np.diag([1.01, 1, 1, 1]).tolist()}"),
            ["T_camera_world is not rigid", "limit 0.001"],
        ),
        (
            line("robot", f'robot = "builtin:psm_lnd"\nT_world_base = {MIRRORED}'),
            ["'PSM1': T_world_base is a reflection"],
        ),
        (line("images", 'image = "{frame}.png"'), ["'left': images is missing", "Is 'image' a misspelling"]),
        (line("images", 'images = "left.png"'), ["images is 'left.png'", "Add {frame}"]),
        (line("images", 'images = "{fram}.png"'), ["unknown placeholder 'fram'", "Did you mean 'frame'"]),
        (line("images", 'images = "regular/left/*.jpg"'), ["matches 0 files", "has 3 rows"]),
        (line("images", 'images = { smoke = "{frame}.png" }'), ["images.smoke is for an unknown domain", "regular"]),
        (line("images", "images = {}"), ["images is missing for: regular"]),
        (line("images", 'images = "left.mp4"'), ["video", "left.mp4 is missing"]),
        (line("masks", 'background = "bg.png"'), ["background points at", "bg.png, which is missing"]),
        (line("masks", 'mask = "{frame}.png"'), ["mask is not a key of the format", "Did you mean 'masks'"]),
    ],
)
def test_a_wrong_key_is_named_with_the_file_and_the_remedy(tiny_sequence, edit, parts):
    path = tiny_sequence(edit=edit)
    message = error_of(path)
    assert str(path.parent) in message
    for part in parts:
        assert part in message


def edit_cell(table: str, row: int, column: str, value: str) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        rows = [text.split(",") for text in (folder / table).read_text().splitlines()]
        rows[row][rows[0].index(column)] = value
        (folder / table).write_text("\n".join(map(",".join, rows)) + "\n")

    return edit


def edit_file(change: Edit, name: str = "sequence.toml") -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        (folder / name).write_text(change((folder / name).read_text()))

    return edit


def extra_image(folder: Path) -> None:
    edit_file(line("images", 'images = "regular/left/*.png"'))(folder)
    shutil.copy(folder / "regular/left/001.png", folder / "regular/left/extra.png")


WRONG: list[tuple[Callable[[Path], object], list[str]]] = [
    (
        lambda folder: [(folder / f"regular/left/00{row}.png").unlink() for row in range(2, 7)],
        ["5 of 6 files are missing: FOLDER/regular/left/002.png (frame 002)", "and 2 more", "remove the rows"],
    ),
    (lambda folder: (folder / "masks/left/002.png").unlink(), ["1 of 6 files is missing", "sparse_masks = true"]),
    (extra_image, ["'regular/left/*.png' matches 7 files", "has 6 rows"]),
    (edit_file(lambda text: text.replace("[kinematics]", "[kinematics")), ["not readable TOML", "line 4"]),
    (
        edit_file(lambda text: text[: text.index("[[arms]]")] + text[text.index("[[cameras]]") :]),
        ["[[arms]] is missing. Add at least one"],
    ),
    *(
        (
            edit_cell(table, 2, "wrist_yaw", value),
            [f"FOLDER/{table}, line 3, column 'wrist_yaw': {value!r} is not a finite number", "Correct the cell"],
        )
        for table, value in (("kinematics.csv", "NaN"), ("kinematics.csv", ""), ("truth.csv", "inf"))
    ),
    (
        edit_cell("kinematics.csv", 1, "pitch", "-31.5"),
        ["line 2, column 'pitch': read in rad", 'pitch = { column = "pitch", unit = "deg" }'],
    ),
    (edit_cell("kinematics.csv", 1, "insertion", "151"), ['insertion = { column = "insertion", unit = "mm" }']),
    (edit_cell("kinematics.csv", 3, "frame", "1"), ["line 4, column 'frame': frame '001' is already in line 2"]),
    (
        edit_file(lambda text: "\n".join(text.splitlines()[:-1]), "truth.csv"),
        ["FOLDER/truth.csv has 5 rows, but the kinematics table has 6"],
    ),
    (
        edit_cell("truth.csv", 3, "frame", "7"),
        ["truth.csv, line 4 is frame '007', but the kinematics table has frame '003' there"],
    ),
]


@pytest.mark.parametrize(("change", "parts"), WRONG)
def test_a_wrong_file_is_named_with_the_place_and_the_remedy(tiny_sequence, change, parts):
    path = tiny_sequence(frames=6)
    change(path.parent)
    message = error_of(path)
    for part in parts:
        assert part.replace("FOLDER", str(path.parent)) in message


def test_one_pattern_for_several_domains_must_tell_them_apart(tiny_sequence):
    path = tiny_sequence(domains=("regular", "dark"), edit=line("images", 'images = "regular/left/{frame}.png"'))
    assert "for all 2 domains. Add {domain}" in error_of(path)


def test_two_cameras_of_one_name_are_refused(tiny_sequence):
    path = tiny_sequence(cameras=("left", "right"), edit=lambda text: text.replace('"right"', '"left"'))
    assert "[[cameras]] has the name 'left' twice" in error_of(path)


def test_a_missing_sequence_file_and_a_folder_are_named(tmp_path):
    assert f"sequence file {tmp_path / 'none.toml'} is missing" in error_of(tmp_path / "none.toml")
    assert "is a folder. Give the .toml file inside it" in error_of(tmp_path)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["has no rows", "a header and at least one row"]),
        ("frame,yaw\n", ["has no rows"]),
        ("frame;yaw\n1;2\n", ["not separated by ','", "delimiter = ';'"]),
        ("frame,yaw,yaw\n1,2,3\n", ["duplicate columns: 'yaw'"]),
        ("frame,yaw\n1,2\n2\n", ["line 3 has 1 cells, but the header has 2"]),
        ("row,yaw\n1,2\n", ["has no column 'frame'", "`frame` in [kinematics]", "row, yaw"]),
        ("frame,yaw\na,2\n", ["'{frame:03d}' cannot be filled in", "'a'"]),
    ],
)
def test_a_table_of_the_wrong_form_is_refused(tiny_sequence, text, parts):
    path = tiny_sequence()
    (path.parent / "kinematics.csv").write_text(text)
    message = error_of(path)
    for part in ["kinematics.csv", *parts]:
        assert part in message


def test_a_missing_robot_and_a_wrong_base_link_are_named(tiny_sequence):
    message = error_of(tiny_sequence(edit=line("robot", 'robot = "none.urdf"')), RobotError)
    assert "none.urdf is missing" in message
    message = error_of(tiny_sequence(edit=line("robot", 'robot = "builtin:psm_lnd"\nbase_link = "none"')), RobotError)
    assert "there is no link 'none'" in message


def test_an_image_that_vanishes_after_opening_is_named(tiny_sequence):
    path = tiny_sequence()
    sequence = Sequence.open(path)
    image = path.parent / "regular/left/002.png"
    image.unlink()
    with pytest.raises(SequenceError, match=f"image {image} is missing. Restore it"):
        sequence.frame(1)
    assert sequence.frame(0).images


@pytest.mark.parametrize("name", ["regular/left/002.png", "masks/left/002.png"])
def test_an_image_or_mask_of_another_size_is_named_with_both_sizes(tiny_sequence, name):
    path = tiny_sequence()
    cv2.imwrite(str(path.parent / name), np.full((48, 64), 255, np.uint8))
    sequence = Sequence.open(path)
    with pytest.raises(SequenceError, match=r"002.png has 64 x 48 pixels, but .* 'left' has 96 x 72 .*Correct `size`"):
        sequence.frame(1)


def test_unknown_frames_domains_and_cameras_are_named_with_those_that_exist(tiny_sequence):
    sequence = Sequence.open(tiny_sequence())
    with pytest.raises(SequenceError, match="no frame number 3; its frames are 0 to 2"):
        sequence.frame(3)
    with pytest.raises(SequenceError, match="no frame number -1"):
        sequence.frame(-1)
    with pytest.raises(SequenceError, match=r"no domain 'regulr'. Did you mean 'regular'"):
        sequence.frame(0, "regulr")
    with pytest.raises(SequenceError, match=r"no camera 'lift'. Did you mean 'left'"):
        sequence.frame(0, cameras=["lift"])
    with pytest.raises(SequenceError, match="no camera 'right'"):
        sequence.background("right")


@pytest.mark.parametrize(
    ("what", "name"),
    [
        *((what, "../../x") for what in ("sequence", "camera", "domain", "arm", "frame")),
        *(("camera", name) for name in ("/tmp/x", ".ssh", "a\\u0000b", "a\\u001b[2Jb", "x" * 201)),
    ],
)
def test_unsafe_names_are_refused(tiny_sequence: Callable[..., Path], what: str, name: str) -> None:
    before, after = {
        "sequence": ('name = "tiny"', f'name = "{name}"'),
        "camera": ('name = "left"', f'name = "{name}"'),
        "domain": ("['regular']", f'["{name}"]'),
        "arm": ('name = "PSM1"', f'name = "{name}"'),
        "frame": ('frame_id = "{frame:03d}"', f'frame_id = "{name}{{frame}}"'),
    }[what]
    path = tiny_sequence(edit=lambda text: text.replace(before, after))
    with pytest.raises(SequenceError, match=r"which (starts|contains|is 2\d\d bytes).* Names are used in"):
        Sequence.open(path)
