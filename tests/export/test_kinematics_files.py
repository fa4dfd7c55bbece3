"""Kinematics, base frames and videos, read back."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from awkward import ARMS, CAMERA, SOURCES, all_views

from carts_core.errors import SequenceError
from carts_core.export import Dataset, FormatName, export, read_kinematics_csv
from carts_core.export.kinematics import joint_columns, kinematics_csv
from carts_core.export.video import frame_rate
from carts_core.recording.importing import read_base_frames


def _positions(dataset: Dataset) -> np.ndarray:
    return np.array([np.concatenate([frame.joint_positions[arm] for arm in ARMS]) for frame in dataset.frames])


def _std(dataset: Dataset) -> np.ndarray:
    std = np.full(_positions(dataset).shape, np.nan)
    known = (dataset.frames[2].joint_std or {})[ARMS[0]]
    std[2, : len(known)] = known
    return std


def test_csv_comes_back(dataset: Dataset, tmp_path: Path) -> None:
    path = export(dataset, "csv", tmp_path / "out.csv")
    rows = read_kinematics_csv(path, dataset.scene)
    assert [(row.frame_id, row.source) for row in rows] == [
        (frame.frame_id, source) for frame, source in zip(dataset.frames, SOURCES, strict=True)
    ]
    values = np.array([np.concatenate([row.joint_positions[arm] for arm in ARMS]) for row in rows])
    np.testing.assert_allclose(values, _positions(dataset), rtol=0, atol=1e-6)
    std = np.array([np.concatenate([(row.joint_std or {})[arm] for arm in ARMS]) for row in rows])
    np.testing.assert_allclose(std, _std(dataset), rtol=0, atol=1e-6)


@pytest.mark.parametrize("with_std", [True, False])
def test_verdicts_come_back_with_the_kinematics(dataset: Dataset, tmp_path: Path, with_std: bool) -> None:
    verdicts = ["good", None, "failed"]
    rows = [
        replace(frame, verdict=verdict, joint_std=frame.joint_std if with_std else None)
        for frame, verdict in zip(dataset.frames, verdicts, strict=True)
    ]
    path = tmp_path / "table.csv"
    path.write_text(kinematics_csv(dataset.scene, rows), encoding="utf-8")
    found = read_kinematics_csv(path, dataset.scene)
    assert [row.verdict for row in found] == verdicts
    assert kinematics_csv(dataset.scene, found) == kinematics_csv(dataset.scene, rows)


def _open_joints(dataset: Dataset) -> Dataset:
    """Of the last frame, the image leaves two joints open; of the first two, no deviation is known."""
    std = {ARMS[0]: np.array([1e-3, 1e-3, 1e-3, 0.1, 1e-3, np.nan, 0.02])}
    last = replace(dataset.frames[2], verdict="good", joint_std=std)
    return replace(dataset, frames=(*dataset.frames[:2], last))


def test_joints_that_the_images_leave_open_stand_beside_the_verdict(dataset: Dataset, tmp_path: Path) -> None:
    dataset = _open_joints(dataset)
    names = ["PSM 1.roll", "PSM 1.jaw"]
    path = export(dataset, "csv", tmp_path / "out.csv")
    said = [(row["verdict"], row["not_determined"]) for row in csv.DictReader(path.open(encoding="utf-8"))]
    assert said == [("", ""), ("", ""), ("good", "; ".join(names))]
    with np.load(export(dataset, "npz", tmp_path / "out.npz"), allow_pickle=False) as archive:
        assert archive["not_determined"].tolist() == ["", "", "; ".join(names)]
    content = json.loads(export(dataset, "json", tmp_path / "out.json").read_text(encoding="utf-8"))
    assert [frame["not_determined"] for frame in content["frames"]] == [None, None, names]
    summary = json.loads((export(dataset, "masks", tmp_path / "png") / "export.json").read_text(encoding="utf-8"))
    assert [view["not_determined"] for view in summary["views"]] == [None, None, names]


def test_tables_of_earlier_versions_end_with_the_verdict(dataset: Dataset, tmp_path: Path) -> None:
    path = export(_open_joints(dataset), "csv", tmp_path / "out.csv")
    rows = list(csv.reader(path.open(encoding="utf-8")))
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows(row[:-1] for row in rows)
    assert [row.verdict for row in read_kinematics_csv(path, dataset.scene)] == [None, None, "good"]


@pytest.mark.parametrize("text", ["frame,a\n1,2\n", "", "\udcff"])
def test_a_table_of_something_else_is_refused(dataset: Dataset, tmp_path: Path, text: str) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(SequenceError, match=str(path)):
        read_kinematics_csv(path, dataset.scene)
    with pytest.raises(SequenceError, match="not a readable kinematics table"):
        read_kinematics_csv(tmp_path / "missing.csv", dataset.scene)


def test_a_row_that_is_cut_off_is_refused(dataset: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(kinematics_csv(dataset.scene, dataset.frames).rstrip()[:-30], encoding="utf-8")
    with pytest.raises(SequenceError, match=r"line 4: expected \d+ numbers"):
        read_kinematics_csv(path, dataset.scene)


def test_npz_comes_back_without_pickles(dataset: Dataset, tmp_path: Path) -> None:
    with np.load(export(dataset, "npz", tmp_path / "out.npz"), allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["joint_positions"], _positions(dataset))
        np.testing.assert_array_equal(archive["joint_std"], _std(dataset))
        assert archive["column"].tolist() == joint_columns(dataset.scene)
        assert archive["frame_id"].tolist() == [frame.frame_id for frame in dataset.frames]
        assert archive["index"].tolist() == [0, 1, 2] and archive["source"].tolist() == list(SOURCES)
        assert (
            dict(zip(archive["column"].tolist(), archive["unit"].tolist(), strict=True))[f"{ARMS[1]}.insertion"] == "m"
        )
        assert (archive["unit"] == "rad").sum() == len(archive["unit"]) - 2


def test_json_comes_back_with_null_for_what_is_not_known(dataset: Dataset, tmp_path: Path) -> None:
    content = json.loads(export(dataset, "json", tmp_path / "out.json").read_text(encoding="utf-8"))
    columns = joint_columns(dataset.scene)
    assert list(content["units"]) == columns and content["units"][f"{ARMS[0]}.yaw"] == "rad"
    assert [(frame["frame"], frame["index"], frame["source"]) for frame in content["frames"]] == [
        (frame.frame_id, frame.index, frame.source) for frame in dataset.frames
    ]
    positions = [[frame["joint_positions"][column] for column in columns] for frame in content["frames"]]
    np.testing.assert_array_equal(positions, _positions(dataset))
    deviations = [[frame["joint_std"][column] for column in columns] for frame in content["frames"]]
    assert deviations[0] == [None] * len(columns)
    np.testing.assert_array_equal(np.array(deviations, dtype=float), _std(dataset))


def test_a_file_gets_the_suffix_of_its_format(dataset: Dataset, tmp_path: Path) -> None:
    assert export(dataset, "npz", tmp_path / "v1.2") == tmp_path / "v1.2.npz"
    assert export(dataset, "json", tmp_path / "OUT.JSON") == tmp_path / "OUT.JSON"


@pytest.mark.parametrize(
    ("name", "frame", "reference", "transform"),
    [
        ("dvrk", "base_frame", "reference_frame", "transform"),
        ("dvrk-2.3", "base-frame", "reference-frame", "transform"),
        ("dvrk-suj", None, None, "measured_cp"),
    ],
)
def test_base_frames_have_the_keys_of_their_version_and_the_dvrks_axes_of_the_camera(
    dataset: Dataset, tmp_path: Path, name: FormatName, frame: str | None, reference: str | None, transform: str
) -> None:
    path = export(dataset, name, tmp_path / "out.json")
    content = json.loads(path.read_text(encoding="utf-8"))
    assert [arm["name"] for arm in content["arms"]] == list(ARMS)
    camera = dataset.scene.cameras[0]
    tip = np.array([0.01, 0.02, -0.1, 1.0])
    read_back = read_base_frames(path)
    for arm, entry, back in zip(dataset.scene.arms, content["arms"], read_back, strict=True):
        # The schema of 2.4 allows no other keys.
        assert set(entry) == {"name", frame or transform}
        values = entry[frame] if frame else entry
        if reference:
            assert set(values) == {reference, transform} and values[reference] == CAMERA
        x, y, z, one = np.array(values[transform]) @ tip
        seen = camera.T_camera_world @ arm.T_world_base @ tip
        # OpenCV has x right and y down, the dVRK x left and y up; both look along z.
        np.testing.assert_allclose([-x, -y, z, one], seen, rtol=0, atol=1e-6)
        np.testing.assert_allclose(back.T_camera_base @ tip, seen, rtol=0, atol=1e-6)


def test_a_video_shows_every_frame_and_the_arms(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "video", tmp_path / "out")
    with av.open(str(folder / "linke_Kamera_ü.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.average_rate) == ("h264", 10)
        pictures = [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
    camera = dataset.scene.cameras[0]
    assert [picture.shape for picture in pictures] == [(128, 162, 3)] * 3, "odd sizes are padded"
    for view, picture in zip(all_views(dataset), pictures, strict=True):
        difference = np.abs(picture[: camera.height, : camera.width].astype(float) - dataset.image(view)).mean(-1)
        arms = view.link_ids >= 0
        assert difference[~arms].mean() < 6
        assert not arms.any() or difference[arms].mean() > 12


@pytest.mark.parametrize(("given", "times", "expected"), [(30.0, True, 30.0), (None, True, 10.0), (None, False, 25.0)])
def test_a_video_runs_as_set_or_recorded_or_at_25(own_dataset: Dataset, given, times: bool, expected: float) -> None:
    if not times:
        own_dataset.sequence.timestamps = None
    assert frame_rate(replace(own_dataset, frame_rate=given)) == pytest.approx(expected)
