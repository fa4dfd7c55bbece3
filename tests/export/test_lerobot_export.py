"""Results written into copies of LeRobot data sets, read back with pyarrow in LeRobot's layout."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet
import pytest
from corrected_frames import corrected
from lerobot_sets import CAMERAS, JOINTS, LENGTHS, POSES, STATISTICS, dataset, states, two_arms, with_states
from recordings import digests, pose_of, with_hidden_twins
from table_robots import write_table_set

from carts_core.cli import main
from carts_core.errors import CartsError
from carts_core.export import Dataset, ExportProgress, export, formats_of, kinematics_csv, measured_frames
from carts_core.export.kinematics import joint_columns
from carts_core.model.psm_kinematics import JOINT_NAMES, forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import import_recording
from carts_core.recording.sequence_file import calibrated_sequence_file
from carts_core.settings.interchange import ImportOptions

STATE = "observation.state_corrected"
MASK = "observation.images.endoscope.left_mask"


def imported(path: Path, folder: Path, options: ImportOptions | None = None) -> Dataset:
    sequence = Sequence.open(import_recording(path, folder, options)[0])
    return Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")


def episode_rows(root: Path, episode: int) -> dict[str, list]:
    """Rows of an episode, found as LeRobot finds them: by the file in v2.1, by `episode_index` in v3.0."""
    info = json.loads((root / "meta/info.json").read_text())
    if info["codebase_version"] == "v2.1":
        return pyarrow.parquet.read_table(root / f"data/chunk-000/episode_{episode:06d}.parquet").to_pydict()
    table = pyarrow.parquet.read_table(root / "data/chunk-000/file-000.parquet")
    return table.filter([one == episode for one in table["episode_index"].to_pylist()]).to_pydict()


def pixels(entry: dict[str, bytes]) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(entry["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("names", [POSES, JOINTS], ids=["poses", "joints"])
def test_results_come_back_equal_to_the_project_and_the_source_is_untouched(tmp_path, version, names):
    path = dataset(tmp_path / "set", version, names)
    before = digests(path)
    data = imported(path, tmp_path / "sequence")
    out = export(data, "lerobot", tmp_path / "out")
    assert digests(path) == before
    rows, recorded = episode_rows(out, 0), episode_rows(path, 0)
    assert {key: rows[key] for key in recorded} == recorded
    (arm,) = data.scene.arms
    positions = np.array([frame.joint_positions[arm.name] for frame in data.frames])
    np.testing.assert_allclose(rows["carts.joint_positions"], positions, rtol=0, atol=1e-9)
    std = np.array(
        [(frame.joint_std or {}).get(arm.name, np.full(positions.shape[1], np.nan)) for frame in data.frames]
    )
    np.testing.assert_allclose(rows["carts.joint_std"], std, rtol=0, atol=1e-9)
    assert rows["carts.corrected"] == [True, False, True, True]
    assert rows["carts.source"] == [frame.source for frame in data.frames]
    assert rows["carts.verdict"] == ["good", "", "doubtful", "good"]
    state, old = np.array(rows[STATE]), np.array(recorded["observation.state"])
    np.testing.assert_array_equal(state[1], old[1])
    changed = [0, 2, 3]
    if names is POSES:
        expected = np.array([pose_of(forward(values[:6])) for values in positions])
        signs = np.sign((expected[:, 3:] * old[:, 3:7]).sum(1))
        expected[:, 3:] *= signs[:, None]
        np.testing.assert_allclose(state[changed, :7], expected[changed], rtol=0, atol=1e-9)
        np.testing.assert_allclose(state[changed, 7], positions[changed, 6], rtol=0, atol=1e-9)
    else:
        np.testing.assert_allclose(state[changed, :7], positions[changed], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(state[:, 7:], old[:, 7:])
        described = json.loads((out / "meta/carts.json").read_text())
        assert described["recorded_columns"] == JOINTS[7:] and described["corrected_columns"]["PSM2_jaw"] == "PSM2.jaw"


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_other_episodes_are_marked_and_every_feature_is_described(tmp_path, version):
    path = dataset(tmp_path / "set", version)
    data = imported(path, tmp_path / "sequence")
    out = export(data, "lerobot", tmp_path / "out")
    rows, recorded = episode_rows(out, 1), episode_rows(path, 1)
    assert rows[STATE] == recorded["observation.state"]
    assert np.isnan(rows["carts.joint_positions"]).all() and not any(rows["carts.corrected"])
    assert set(rows["carts.source"]) == {""}
    info, old = (json.loads((folder / "meta/info.json").read_text()) for folder in (out, path))
    added = {key: value for key, value in info["features"].items() if key not in old["features"]}
    assert {**info, "features": old["features"]} == old
    assert added["carts.joint_positions"] == {
        "dtype": "float64",
        "shape": [len(joint_columns(data.scene))],
        "names": joint_columns(data.scene),
    }
    assert added[STATE]["names"] == POSES and added[MASK]["dtype"] == "image" and added[MASK]["shape"] == [72, 96, 3]
    assert set(rows) == set(recorded) | set(added)
    file = next(iter(sorted((out / "data").rglob("*.parquet"))))
    schema = pyarrow.parquet.read_schema(file)
    described = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    assert set(described) == set(schema.names)
    assert described[MASK] == {"_type": "Image"} and described["carts.verdict"] == {"dtype": "string", "_type": "Value"}
    assert described["carts.joint_std"]["feature"]["dtype"] == "float64"
    assert schema.field("carts.joint_std").type.list_size == len(joint_columns(data.scene))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_masks_are_images_of_the_rendered_masks_and_empty_elsewhere(tmp_path, version):
    data = imported(dataset(tmp_path / "set", version), tmp_path / "sequence")
    out = export(data, "lerobot", tmp_path / "out")
    rows = episode_rows(out, 0)
    views = [view for view in data.views(ExportProgress()) if view.camera.name == "left"]
    assert sum((view.link_ids >= 0).sum() for view in views) > 0
    for view, entry in zip(views, rows[MASK], strict=True):
        expected = np.repeat((view.link_ids >= 0)[..., None] * np.uint8(255), 3, -1)
        np.testing.assert_array_equal(pixels(entry), expected)
    assert not any(pixels(entry).any() for entry in episode_rows(out, 1)[MASK])


def test_masks_have_the_names_of_the_videos_that_were_chosen_for_their_cameras(tmp_path):
    left, right = CAMERAS
    options = ImportOptions(images={"left": right, "right": left})
    path, _ = import_recording(dataset(tmp_path / "set"), tmp_path / "sequence", options)
    sequence = Sequence.open(path)
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene.with_cameras(["left"]), "regular")
    rows = episode_rows(export(data, "lerobot", tmp_path / "out"), 0)
    assert MASK not in rows
    for view, entry in zip(data.views(ExportProgress()), rows[f"{right}_mask"], strict=True):
        assert ((pixels(entry)[..., 0] > 0) == (view.link_ids >= 0)).all()


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_statistics_of_the_new_features_join_those_of_the_data_set(tmp_path, version):
    data = imported(dataset(tmp_path / "set", version), tmp_path / "sequence")
    out = export(data, "lerobot", tmp_path / "out")
    if version == "v2.1":
        lines = [json.loads(line) for line in (out / "meta/episodes_stats.jsonl").read_text().splitlines()]
        stats, rows = lines[0]["stats"], episode_rows(out, 0)
        assert lines[1]["stats"][MASK]["max"] == [[[0.0]]] * 3
    else:
        stats = json.loads((out / "meta/stats.json").read_text())
        rows = {key: values + episode_rows(out, 1)[key] for key, values in episode_rows(out, 0).items()}
    assert stats["observation.state"] == STATISTICS
    np.testing.assert_allclose(stats[STATE]["mean"], np.mean(rows[STATE], axis=0), atol=1e-12)
    assert stats[STATE]["count"] == [len(rows[STATE])]
    pictures = [pixels(one) for one in rows[MASK]]
    np.testing.assert_allclose(np.array(stats[MASK]["mean"]).ravel(), np.mean(pictures) / 255, atol=1e-12)
    assert stats[MASK]["count"] == [len(pictures)]


def test_episodes_are_exported_one_after_another(tmp_path):
    path = dataset(tmp_path / "set")
    first = export(imported(path, tmp_path / "first"), "lerobot", tmp_path / "out1")
    data = imported(path / "data/chunk-000/episode_000001.parquet", tmp_path / "second")
    data = replace(data, recording=first / "data/chunk-000/episode_000001.parquet")
    second = export(data, "lerobot", tmp_path / "out2")
    earlier, kept = episode_rows(first, 0), episode_rows(second, 0)
    np.testing.assert_equal(kept, earlier)
    rows = episode_rows(second, 1)
    np.testing.assert_allclose(
        rows["carts.joint_positions"], [frame.joint_positions["PSM1"] for frame in data.frames], rtol=0, atol=1e-9
    )
    stats = [
        json.loads((folder / "meta/episodes_stats.jsonl").read_text().splitlines()[0]) for folder in (first, second)
    ]
    np.testing.assert_equal(stats[1], stats[0])
    assert len(rows[STATE]) == LENGTHS[1]


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_hidden_files_of_macos_are_ignored(tmp_path, version):
    path = with_hidden_twins(dataset(tmp_path / "set", version), "*.parquet")
    out = export(imported(path, tmp_path / "sequence"), "lerobot", tmp_path / "out")
    assert episode_rows(out, 0)["carts.corrected"] == [True, False, True, True] and not [*out.rglob("._*")]


def test_videos_are_linked_copied_or_left_out(tmp_path):
    path = dataset(tmp_path / "set")
    data = imported(path, tmp_path / "sequence")
    videos = sorted(file.relative_to(path) for file in path.rglob("*.mp4"))
    for images in ("named", "copied", "none"):
        out = export(replace(data, images=images), "lerobot", tmp_path / images)
        assert sorted(file.relative_to(out) for file in out.rglob("*.mp4")) == ([] if images == "none" else videos)
        assert all((out / file).is_symlink() == (images == "named") for file in videos if images != "none")
        assert all((out / file).read_bytes() == (path / file).read_bytes() for file in videos if images != "none")


def test_with_a_time_offset_the_state_of_every_frame_is_at_the_time_of_its_image(tmp_path):
    path = dataset(tmp_path / "set", names=JOINTS)
    options = ImportOptions(time_offset=1 / 30)
    sequence = Sequence.open(import_recording(path, tmp_path / "sequence", options)[0])
    frames = [replace(frame, source="optimized") for frame in measured_frames(sequence, range(3))]
    frames[1] = replace(frames[1], source="measured")
    data = Dataset(sequence, tuple(frames), sequence.scene, "regular")
    rows = episode_rows(export(data, "lerobot", tmp_path / "out"), 0)
    assert rows["carts.corrected"] == [True, False, True, False]
    shifted = np.array(rows["observation.state"])[[1, 2, 3, 3], :7]
    np.testing.assert_allclose(np.array(rows[STATE])[:, :7], shifted, rtol=0, atol=1e-8)


def test_single_precision_states_stay_single(tmp_path):
    data = imported(dataset(tmp_path / "set", names=JOINTS, kind="float32"), tmp_path / "sequence")
    out = export(data, "lerobot", tmp_path / "out")
    file = out / "data/chunk-000/episode_000000.parquet"
    assert pyarrow.parquet.read_schema(file).field(STATE).type.value_type == pyarrow.float32()
    positions = np.array([frame.joint_positions["PSM2"] for frame in data.frames])
    np.testing.assert_allclose(np.array(episode_rows(out, 0)[STATE])[:, :7], positions, rtol=0, atol=2e-7)


def test_degrees_and_percent_come_back_in_their_units(tmp_path):
    path = dataset(tmp_path / "set", names=JOINTS)
    file = path / "data/chunk-000/episode_000000.parquet"
    table = pyarrow.parquet.read_table(file)
    state = np.array(table["observation.state"].to_pylist())
    state[:, [0, 1, 3, 4, 5, 6]] *= 180 / np.pi
    state[:, 2] *= -1000
    column = pyarrow.array(state.tolist())
    pyarrow.parquet.write_table(table.set_column(0, "observation.state", column), file)
    options = ImportOptions(angle_unit="deg", length_unit="mm", flip=("insertion",))
    sequence = Sequence.open(import_recording(path, tmp_path / "sequence", options)[0])
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")
    rows = episode_rows(export(data, "lerobot", tmp_path / "out"), 0)
    positions = np.array([frame.joint_positions["PSM2"] for frame in data.frames])[2]
    found = np.array(rows[STATE])[2]
    np.testing.assert_allclose(found[[0, 1, 3, 4, 5, 6]], np.degrees(positions[[0, 1, 3, 4, 5, 6]]), rtol=0, atol=1e-9)
    assert found[2] == pytest.approx(-1000 * positions[2], abs=1e-9)


def test_motor_positions_of_a_table_robot_come_back_in_percent(tmp_path):
    made = write_table_set(tmp_path / "made", frames=4)
    options = ImportOptions(robot={"arm": str(made.urdf)}, angle_unit="percent", flip=("gripper",))
    data = imported(made.folder, tmp_path / "sequence", options)
    rows = episode_rows(export(data, "lerobot", tmp_path / "out"), 0)
    (arm,) = data.scene.arms
    lower, upper = arm.robot.joint_limits.T
    expected = np.array([frame.joint_positions["arm"] for frame in data.frames]) * [1, 1, 1, 1, 1, -1]
    expected = 100 * (expected - lower) / (upper - lower) * [2, 2, 2, 2, 2, 1] - [100, 100, 100, 100, 100, 0]
    np.testing.assert_allclose(rows[STATE], expected, rtol=0, atol=1e-5)


def assert_state(data: Dataset, folder: Path, arms: list[str]) -> None:
    """The corrected state consists of the joint positions of the arms."""
    state = episode_rows(export(data, "lerobot", folder), 0)[STATE]
    expected = [np.concatenate([frame.joint_positions[arm] for arm in arms]) for frame in data.frames]
    np.testing.assert_allclose(state, expected, rtol=0, atol=1e-8)


def test_arms_that_were_renamed_and_swapped_are_recognized_by_their_values(tmp_path):
    path = two_arms(tmp_path / "set")
    for number, names in enumerate([("LEFT", "RIGHT"), ("PSM2", "PSM1")]):
        options = ImportOptions(arms=dict(zip(names, ("PSM1", "PSM2"), strict=True)))
        assert_state(imported(path, tmp_path / f"sequence{number}", options), tmp_path / f"out{number}", [*names])


def test_columns_that_were_chosen_are_recognized_by_their_values(tmp_path):
    names = [f"m{letter}" for letter in "abcdefg"]
    path = with_states(dataset(tmp_path / "set"), names, [row[:7] for row in states(JOINTS, 0, LENGTHS[0])])
    options = ImportOptions(columns=dict(zip([*JOINT_NAMES, "jaw"], names, strict=True)))
    assert_state(imported(path, tmp_path / "sequence", options), tmp_path / "out", ["PSM1"])


def test_the_command_finds_the_recording_and_refuses_another_one(tmp_path):
    path = dataset(tmp_path / "set")
    file, _ = import_recording(path, tmp_path / "sequence")
    sequence = Sequence.open(file)
    assert sequence.recording is not None and sequence.recording.resolve() == path
    assert "lerobot" in formats_of(sequence)
    table = tmp_path / "kinematics.csv"
    table.write_text(kinematics_csv(sequence.scene, corrected(sequence)))
    main(["export", str(file), str(tmp_path / "out"), "--format", "lerobot", "--kinematics", str(table)])
    assert episode_rows(tmp_path / "out", 0)["carts.corrected"] == [True, False, True, True]
    other = path / "data/chunk-000/episode_000001.parquet"
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular", recording=other)
    with pytest.raises(CartsError, match=r"joint positions of .* are not those of episode 1"):
        export(data, "lerobot", tmp_path / "wrong")
    assert not (tmp_path / "wrong").exists()


def test_missing_and_unknown_recordings_are_errors_in_words(tmp_path, tiny_sequence):
    sequence = Sequence.open(tiny_sequence())
    data = Dataset(sequence, tuple(corrected(sequence)), sequence.scene, "regular")
    assert "lerobot" not in formats_of(sequence)
    with pytest.raises(CartsError, match=r"does not name the recording it was imported from.*--recording"):
        export(data, "lerobot", tmp_path / "out")
    with pytest.raises(CartsError, match="is missing"):
        export(replace(data, recording=tmp_path / "nothing"), "lerobot", tmp_path / "out")
    with pytest.raises(CartsError, match="is not a LeRobot data set"):
        export(replace(data, recording=tmp_path), "lerobot", tmp_path / "out")
    with pytest.raises(CartsError, match=r"frame '003' of .* and its row of episode 0 .* are 0\.1333 s apart"):
        export(replace(data, recording=dataset(tmp_path / "set")), "lerobot", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_calibrated_copy_of_the_sequence_file_keeps_the_recording(tmp_path):
    path = dataset(tmp_path / "set")
    file, _ = import_recording(path, tmp_path / "sequence")
    scene = Sequence.open(file).scene
    copy = tmp_path / "elsewhere/deeper/sequence.toml"
    copy.parent.mkdir(parents=True)
    copy.write_text(calibrated_sequence_file(file, copy.parent, scene, scene))
    found = Sequence.open(copy).recording
    assert found is not None and found.resolve() == path
