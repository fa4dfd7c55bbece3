"""LeRobot data set of a robot with its own meshes: from motor positions and masks to a hand-eye calibration."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from table_robots import TableSet, write_table_set

from carts_core.cli.command_line import main
from carts_core.recording import Sequence

Refused = Callable[..., str]


@pytest.fixture(scope="module")
def table_set(tmp_path_factory: pytest.TempPathFactory) -> TableSet:
    return write_table_set(tmp_path_factory.mktemp("table"))


def imported(given: TableSet, folder: Path) -> Path:
    options = ["--robot", "arm", given.urdf, "--angle-unit", "percent", "--calibration", "front", given.calibration]
    main(["import", *map(str, [given.folder, "-o", folder, *options])])
    return folder / "sequence.toml"


@pytest.mark.slow
def test_three_commands_calibrate_the_camera_of_an_arm_with_masks(table_set: TableSet, tmp_path: Path) -> None:
    """Ten frames, units of -100 to 100, and no initial pose: within 0.3 deg and 3 mm."""
    sequence, masks = imported(table_set, tmp_path / "imported"), ["--masks", str(table_set.masks)]
    main(["hand-eye", str(sequence), *masks, "--output", str(tmp_path / "hand-eye")])
    rough = tmp_path / "hand-eye" / "sequence.toml"
    main(["calibrate", str(rough), "--observe", "masks", *masks, "--output", str(tmp_path / "calibrated")])
    for file, degrees, metres in ((rough, 10.0, 0.1), (tmp_path / "calibrated" / "sequence.toml", 0.3, 0.003)):
        scene = Sequence.open(file).scene
        T = scene.cameras[0].T_camera_world @ scene.arms[0].T_world_base
        turn = Rotation.from_matrix(T[:3, :3].T @ table_set.T_camera_base[:3, :3]).magnitude()
        assert np.degrees(turn) < degrees and np.linalg.norm((T - table_set.T_camera_base)[:3, 3]) < metres


def test_units_of_motor_positions_are_asked_for(table_set: TableSet, tmp_path: Path, refused: Refused) -> None:
    said = refused("import", table_set.folder, "-o", tmp_path / "new", "--robot", "arm", table_set.urdf)
    assert "LeRobot does not store the unit" in said and "percent (-100 to 100" in said
    assert not (tmp_path / "new").exists()


def test_masks_that_no_pose_fits_are_refused(table_set: TableSet, tmp_path: Path, refused: Refused) -> None:
    sequence, wrong = imported(table_set, tmp_path / "imported"), tmp_path / "wrong"
    wrong.mkdir()
    for path in table_set.masks.iterdir():
        stripes = np.zeros((240, 320), np.uint8)
        stripes[::12] = 255
        cv2.imwrite(str(wrong / path.name), stripes)
    out = tmp_path / "out"
    for arguments, said in (
        (["--masks", wrong], "no pose of arm fits the masks"),
        ([], "give either --points FILE"),
        (["--masks", "recording"], "no frame has a mask"),
        (["--masks", wrong, "--camera", "side"], "there is no camera 'side'"),
    ):
        assert said in refused("hand-eye", sequence, *arguments, "--output", out) and not out.exists()
