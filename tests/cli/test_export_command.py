"""`carts export`, as a user types it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pycocotools.coco import COCO

from carts_core.cli.command_line import main
from carts_core.export import FORMATS, FormatName, KinematicsRow, kinematics_csv
from carts_core.recording import Sequence
from carts_core.recording.images import read_mask


@pytest.fixture
def sequence(tiny_sequence: Callable[..., Path]) -> str:
    return str(tiny_sequence(frames=3, domains=("regular", "smoke"), cameras=("left", "right"), width=160, height=128))


def _coco(folder: Path) -> Any:  # its own type hints know no further keys of an image
    return COCO(str(folder / "annotations" / "instances_default.json"))


@pytest.mark.parametrize("name", ["coco", "yolo", "csv", "dvrk"])
def test_a_format_is_written_as_a_folder_or_a_file(sequence: str, tmp_path: Path, name: FormatName) -> None:
    (tmp_path / "exports").mkdir()
    main(["export", sequence, str(tmp_path / "exports" / "out"), "--format", name, "--frames", "002"])
    (written,) = (tmp_path / "exports").iterdir()
    assert written.name == "out" + FORMATS[name].suffix
    assert written.is_dir() == (not FORMATS[name].suffix)


def test_the_command_knows_every_format() -> None:
    assert list(FORMATS) == list(get_args(FormatName))


def test_frames_cameras_and_domain_are_chosen(sequence: str, tmp_path: Path) -> None:
    choice = ["--frames", "001,003", "--camera", "right", "--domain", "smoke", "--parts", "links"]
    main(["export", sequence, str(tmp_path / "out"), "--format", "coco", *choice])
    images = list(_coco(tmp_path / "out").imgs.values())
    assert [(image["frame"], image["camera"]) for image in images] == [("001", "right"), ("003", "right")]
    assert {category["supercategory"] for category in _coco(tmp_path / "out").cats.values()} == {"PSM1"}
    assert [image["file_name"] for image in images] == ["smoke/right/001.png", "smoke/right/003.png"]


def test_corrected_kinematics_decide_frames_and_masks(sequence: str, tmp_path: Path) -> None:
    opened = Sequence.open(sequence)
    truth = (opened.truth or {})["PSM1"]
    rows = [KinematicsRow(opened.frame_ids[index], "optimized", {"PSM1": truth[index]}) for index in (1, 2)]
    table = tmp_path / "kinematics of mine.csv"
    table.write_text(kinematics_csv(opened.scene, rows))
    command = ["export", sequence, str(tmp_path / "out"), "--kinematics", str(table), "--camera", "left"]
    main([*command, "--format", "coco"])
    coco = _coco(tmp_path / "out")
    assert [(image["frame"], image["source"]) for image in coco.imgs.values()] == [
        ("002", "optimized"),
        ("003", "optimized"),
    ]
    for annotation in coco.anns.values():
        frame = coco.imgs[annotation["image_id"]]["frame"]
        true = read_mask(Path(sequence).parent / "masks" / "left" / f"{frame}.png")
        np.testing.assert_array_equal(coco.annToMask(annotation) > 0, true)
    main([*command, "--format", "csv"])
    assert (tmp_path / "out.csv").read_bytes() == table.read_bytes()


def test_bad_choices_are_told_and_write_nothing(sequence: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    before = sorted(tmp_path.iterdir())
    for options, message in (
        (["--domain", "all"], "an export has one domain"),
        (["--frames", "9"], "--frames 9: there is no '9'"),
        (["--frame-rate", "0"], "frame rate"),
        (["--kinematics", "missing.csv"], "missing.csv is not a readable kinematics table"),
    ):
        assert message in refused("export", sequence, tmp_path / "out", "--format", "coco", *options)
        assert sorted(tmp_path.iterdir()) == before
