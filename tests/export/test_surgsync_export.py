"""Results written into copies of SurgSync recordings, read back with pyarrow and json in SurgSync's layouts."""

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet
import pytest
from corrected_frames import corrected
from recordings import T_CAMERA_BASE, digests, with_hidden_twins
from scipy.spatial.transform import Rotation
from surgsync_recordings import clip, episode

from carts_core.errors import CartsError
from carts_core.export import Dataset, ExportProgress, export
from carts_core.model.camera import T_DVRK_OPENCV
from carts_core.model.psm_kinematics import forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording
from carts_core.settings.interchange import ImportOptions


def imported(path: Path, folder: Path, options: ImportOptions | None = None) -> Dataset:
    sequence = Sequence.open(import_recording(path, folder, options)[0])
    return Dataset(sequence, tuple(corrected(sequence)), sequence.scene.with_cameras(["left"]), "regular")


def assert_poses(positions: np.ndarray, found: np.ndarray, T_reference_base: np.ndarray) -> None:
    expected = T_reference_base @ forward(positions)
    np.testing.assert_allclose(found[:, :3], expected[:, :3, 3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(found[:, 3:]).as_matrix(), expected[:, :3, :3], rtol=0, atol=1e-9)


def test_a_packed_episode_gets_columns_equal_to_the_project(tmp_path):
    path = episode(tmp_path / "source")
    before = digests(path)
    data = imported(path, tmp_path / "sequence")
    out = export(data, "surgsync", tmp_path / "out")
    assert digests(path) == before
    rows, recorded = (pyarrow.parquet.read_table(folder / "PSM1.parquet").to_pydict() for folder in (out, path))
    assert {key: rows[key] for key in recorded} == recorded
    positions = np.array([frame.joint_positions["PSM1"] for frame in data.frames])
    np.testing.assert_allclose(rows["corrected_js.position"], positions[:, :6], rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows["jaw.corrected_position"], positions[:, 6], rtol=0, atol=1e-9)
    assert np.isnan(rows["corrected_js.std"][1]).all()
    assert rows["corrected_js.std"][0] == pytest.approx(np.linspace(1e-4, 1e-3, 7)[:6])
    assert rows["corrected"][:3] == [True, False, True] and rows["corrected.verdict"][:3] == ["good", "", "doubtful"]
    local = np.column_stack([rows["local_corrected_cp.position"], rows["local_corrected_cp.orientation"]])
    assert_poses(positions[:, :6], local, np.eye(4))
    seen = np.column_stack([rows["corrected_cp.position"], rows["corrected_cp.orientation"]])
    T = T_DVRK_OPENCV @ T_CAMERA_BASE
    np.testing.assert_allclose(seen[:, :3], (T @ forward(positions[:, :6]))[:, :3, 3], rtol=0, atol=1e-7)
    assert find(out).frame_ids == data.sequence.frame_ids


def test_a_raw_clip_gets_corrected_data_beside_its_measured_data(tmp_path):
    path = clip(tmp_path / "source")
    (path / "kinematic/PSM1/3.json").unlink()
    before = digests(path)
    data = imported(path, tmp_path / "sequence")
    out = export(data, "surgsync", tmp_path / "out")
    assert digests(path) == before
    for frame in data.frames:
        (content,) = json.loads((out / f"kinematic/PSM1/{frame.frame_id}.json").read_text())
        (old,) = json.loads((path / f"kinematic/PSM1/{frame.frame_id}.json").read_text())
        found, jaw = content["arm"].pop("corrected_data"), content["jaw"].pop("corrected_data")
        assert content == old
        positions = frame.joint_positions["PSM1"]
        np.testing.assert_allclose(found["corrected_js"]["position"], positions[:6], rtol=0, atol=1e-9)
        np.testing.assert_allclose(jaw["position"], positions[6:], rtol=0, atol=1e-9)
        assert found["corrected"] == (frame.source != "measured") and found["verdict"] == frame.verdict
        assert (found["corrected_js"]["std"] == [None] * 6) == (frame.joint_std is None)
        local = np.array([[*found["local_corrected_cp"]["position"], *found["local_corrected_cp"]["orientation"]]])
        assert_poses(positions[None, :6], local, np.eye(4))
    assert (out / "image/left/0.png").is_symlink() and not (out / "kinematic/PSM1/3.json").exists()
    assert find(out).frame_ids == data.sequence.frame_ids


@pytest.mark.parametrize("make", [episode, clip])
def test_masks_match_the_recorded_images(tmp_path, make):
    data = imported(make(tmp_path / "source"), tmp_path / "sequence")
    out = export(data, "surgsync", tmp_path / "out")
    camera = data.sequence.recorded_camera("left")
    assert any(camera.distortion)
    for view in data.views(ExportProgress()):
        mask = cv2.imread(str(out / f"annotation/carts_mask/left/{view.frame.frame_id}.png"), cv2.IMREAD_GRAYSCALE)
        assert mask is not None and mask.shape == (72, 96)
        assert np.array_equal(mask > 127, data.recorded_mask(view))
        # The undistorted mask of the recording is the rendered one, except for pixels at its outline.
        again = camera.undistort(mask > 127)
        rendered = view.link_ids >= 0
        inner = cv2.erode(rendered.astype(np.uint8), np.ones((3, 3))) > 0
        near = cv2.dilate(rendered.astype(np.uint8), np.ones((3, 3))) > 0
        middle = slice(4, -4), slice(4, -4)  # Pixels at the border map beyond the rendered image.
        assert (again | ~inner)[middle].all() and (~again | near).all()


@pytest.mark.parametrize("make", [episode, clip])
def test_an_arm_that_was_renamed_is_recognized_by_its_values(tmp_path, make):
    path = make(tmp_path / "source")
    outs = [
        export(imported(path, tmp_path / name, options), "surgsync", tmp_path / f"out_{name}")
        for name, options in {"same": None, "other": ImportOptions(arms={"LEFT": "PSM1"})}.items()
    ]
    first, second = ({name: digest for name, digest in digests(out).items() if "PSM1" in name} for out in outs)
    assert first == second and first != digests(path)


@pytest.mark.parametrize("make", [episode, clip])
def test_an_export_is_imported_and_exported_again(tmp_path, make):
    out = export(imported(make(tmp_path / "source"), tmp_path / "first"), "surgsync", tmp_path / "out")
    again = export(imported(out, tmp_path / "second"), "surgsync", tmp_path / "again")
    assert {file: digest for file, digest in digests(again).items() if file.endswith(".png")} == {
        file: digest for file, digest in digests(out).items() if file.endswith(".png")
    }


@pytest.mark.parametrize("make", [episode, clip])
def test_hidden_files_of_macos_are_ignored(tmp_path, make):
    path = with_hidden_twins(make(tmp_path / "source"), "*.*")
    out = export(imported(path, tmp_path / "sequence"), "surgsync", tmp_path / "out")
    assert find(out).arms and not [*out.rglob("._*")]


@pytest.mark.parametrize("make", [episode, clip])
def test_another_recording_is_refused(tmp_path, make):
    path = make(tmp_path / "source")
    data = imported(path, tmp_path / "sequence")
    if make is clip:
        file = path / "kinematic/PSM1/5.json"
        file.write_text(file.read_text().replace('"position": [', '"position": [1e-3, ', 1))
    else:
        table = pyarrow.parquet.read_table(path / "PSM1.parquet")
        shifted = [[value + 1e-3 for value in row] for row in table["measured_js.position"].to_pylist()]
        index = table.schema.get_field_index("measured_js.position")
        pyarrow.parquet.write_table(table.set_column(index, "measured_js.position", [shifted]), path / "PSM1.parquet")
    with pytest.raises(CartsError, match=r"are not those of .*--recording PATH"):
        export(data, "surgsync", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_files_outside_of_the_recording_are_not_copied(tmp_path):
    path = clip(tmp_path / "source")
    data = imported(path, tmp_path / "sequence")
    (tmp_path / "secret").write_text("key")
    for name in ("notes.txt", "camera_calibration/notes.yaml"):
        (path / name).symlink_to(tmp_path / "secret")
        with pytest.raises(CartsError, match="is a link to a file outside of the recording"):
            export(data, "surgsync", tmp_path / "out")
        (path / name).unlink()
    (path / "notes").symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(CartsError, match="is a link to a file outside of the recording"):
        export(data, "surgsync", tmp_path / "out")
    assert not (tmp_path / "out").exists()
