"""Exports of a recording whose camera moves."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from moving import let_camera_move, swing

from carts_core.errors import CartsError
from carts_core.export import Dataset, ExportFrame, export
from carts_core.recording import Sequence

FRAMES = 4


@pytest.fixture
def dataset(tiny_sequence: Callable[..., Path]) -> Dataset:
    path = tiny_sequence(frames=FRAMES, width=160, height=120)
    sequence = Sequence.open(let_camera_move(path, swing(FRAMES, 3.0, 0.002)))
    assert sequence.truth is not None
    frames = [
        ExportFrame(name, "edited", {arm: rows[index] for arm, rows in sequence.truth.items()}, index=index)
        for index, name in enumerate(sequence.frame_ids)
    ]
    return Dataset(sequence, tuple(frames), sequence.scene, "regular")


def test_masks_are_rendered_from_where_the_camera_was(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "masks", tmp_path / "exported")
    for index in range(FRAMES):
        wanted = (dataset.sequence.frame(index).masks or {})["left"]
        written = cv2.imread(str(folder / "arms" / f"left_{index + 1:03d}.png"), cv2.IMREAD_GRAYSCALE)
        assert written is not None
        assert (wanted != (written > 0)).mean() < 0.001


def test_kinematics_say_where_the_camera_was(dataset: Dataset, tmp_path: Path) -> None:
    Ts = np.linalg.inv(swing(FRAMES, 3.0, 0.002).Ts_world_mount)
    wanted = dataset.scene.cameras[0].T_camera_world @ Ts
    with np.load(export(dataset, "npz", tmp_path / "out.npz")) as found:
        assert found["camera"].tolist() == ["left"]
        np.testing.assert_allclose(found["T_camera_world"][:, 0], wanted, atol=1e-9)
    frames = json.loads(export(dataset, "json", tmp_path / "out.json").read_text())["frames"]
    np.testing.assert_allclose([frame["T_camera_world"]["left"] for frame in frames], wanted, atol=1e-9)


@pytest.mark.parametrize("kind", ["dvrk", "dvrk-2.3", "dvrk-suj"])
def test_the_dvrk_gets_no_fixed_base_frame_of_a_moving_camera(dataset: Dataset, tmp_path: Path, kind) -> None:
    with pytest.raises(CartsError, match="moves, but a dVRK base frame is valid for one camera pose"):
        export(dataset, kind, tmp_path / "out.json")
