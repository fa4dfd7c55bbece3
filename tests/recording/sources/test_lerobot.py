"""Import of LeRobot data sets of both versions."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from lerobot_sets import FRAMES, JOINTS, LENGTHS, POSES, dataset, two_arms, write_parquet
from recordings import assert_refused, copied, image, jaw_at, joints_at, remove, write
from videos import write_video

from carts_core.cli import main
from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording
from carts_core.settings.interchange import ImportOptions


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("names", [POSES, JOINTS], ids=["poses", "joints"])
def test_a_data_set_becomes_a_sequence_by_one_command(tmp_path, version, names):
    path = dataset(tmp_path / "set", version, names)
    main(["import", str(path), "-o", str(tmp_path / "out")])
    sequence = Sequence.open(tmp_path / "out/sequence.toml")
    assert len(sequence) == LENGTHS[0] and [camera.name for camera in sequence.scene.cameras] == ["left", "right"]
    frame = sequence.frame(3)
    arm = "PSM1" if names is POSES else "PSM2"
    assert np.abs(frame.measured[arm][:6] - joints_at(3 / 30)).max() < 1e-8
    assert frame.measured[arm][6] == pytest.approx(float(jaw_at(3 / 30)))
    assert np.abs(frame.images["right"].astype(int) - image(3, "right")).mean() < 6
    assert frame.timestamp == pytest.approx(0.1)


def test_another_episode_is_chosen_by_its_file(tmp_path):
    path = dataset(tmp_path / "set")
    file, found = import_recording(path / "data/chunk-000/episode_000001.parquet", tmp_path / "out")
    assert len(found.frame_ids) == FRAMES
    frame = Sequence.open(file).frame(5)
    assert np.abs(frame.measured["PSM1"][:6] - joints_at((LENGTHS[0] + 5) / 30)).max() < 1e-8
    assert np.abs(frame.images["left"].astype(int) - image(LENGTHS[0] + 5)).mean() < 6


def test_a_second_episode_in_a_shared_video_begins_where_it_begins(tmp_path):
    path = dataset(tmp_path / "set", "v3.0")
    (path / "data/chunk-000/episode_000001.parquet").touch()
    (path / "data/chunk-000/episode_000001.parquet").rename(path / "episode_000001.parquet")
    found = find(path / "episode_000001.parquet")
    assert found.cameras[0].numbers is not None and found.cameras[0].numbers.tolist() == list(range(4, 10))


def test_joints_with_equal_names_under_the_keys_of_two_arms_become_two_arms(tmp_path):
    sequence = Sequence.open(import_recording(two_arms(tmp_path / "set"), tmp_path / "out")[0])
    assert list(sequence.measured) == ["PSM1", "PSM2"]
    for start, values in enumerate(sequence.measured.values()):
        expected = [joints_at(start + number / 30) for number in range(LENGTHS[0])]
        np.testing.assert_allclose(values[:, :6], expected, rtol=0, atol=1e-8)


def info_changed(change: Callable[[dict], object]) -> Callable[[Path], object]:
    def mutate(path: Path) -> None:
        content = json.loads((path / "meta/info.json").read_text())
        change(content)
        (path / "meta/info.json").write_text(json.dumps(content))

    return mutate


FIRST = "data/chunk-000/episode_000000.parquet"
VIDEO = "videos/chunk-000/observation.images.endoscope.left/episode_000000.mp4"
MUTATIONS: dict[str, tuple[Callable[[Path], object], str]] = {
    "info is cut": (write("meta/info.json", "{"), "not a LeRobot description"),
    "info without rate": (info_changed(lambda c: c.pop("fps")), "not a LeRobot description"),
    "info without features": (info_changed(lambda c: c.pop("features")), "not a LeRobot description"),
    "no state": (info_changed(lambda c: c["features"].pop("observation.state")), "has no feature observation.state"),
    "names are too few": (info_changed(lambda c: c["features"]["observation.state"].update(names=["x"])), "1 names"),
    "no names": (info_changed(lambda c: c["features"]["observation.state"].update(names=None)), "0 names"),
    "repeated names": (
        info_changed(lambda c: c["features"]["observation.state"].update(names=["yaw", "pitch", "roll", "jaw"] * 2)),
        "several columns with the same name in meta/info.json: yaw, pitch, roll, jaw",
    ),
    "unknown names": (
        info_changed(lambda c: c["features"]["observation.state"].update(names=[f"motor{c}" for c in "abcdefgh"])),
        "neither six joints of a PSM",
    ),
    "no episode": (remove(FIRST), "has no episode 0"),
    "no rows": (lambda p: write_parquet(p / FIRST, {"observation.state": pyarrow.array([], "float32")}), "no rows"),
    "missing column": (lambda p: write_parquet(p / FIRST, {"state": [1.0]}), "has no feature observation.state"),
    "ragged rows": (lambda p: write_parquet(p / FIRST, {"observation.state": [[1.0], [1.0, 2.0]]}), "differ in length"),
    "missing video": (remove(VIDEO), r"episode_000000\.mp4 is missing"),
    "short video": (
        lambda p: write_video(p / VIDEO, [image(0), image(1)], 30),
        "has 2 frames, but episode 0 consists of frames 0 to 3",
    ),
    "poses elsewhere": (
        lambda p: write_parquet(p / FIRST, {"observation.state": [[1.0, 2, 3, 0, 0, 0, 1, 0]] * 4}),
        "the unit of the tip.s position is ambiguous",
    ),
    "no orientation": (
        lambda p: write_parquet(p / FIRST, {"observation.state": [[0.0] * 8] * 4}),
        "4 of 4 poses are unreachable .the pose is not finite",
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_data_set_is_an_error_in_words_and_leaves_nothing(tmp_path, name):
    mutate, message = MUTATIONS[name]
    path = copied(dataset, tmp_path / "set")
    mutate(path)
    assert_refused(path, message)


def test_a_video_is_asked_for_by_its_feature(tmp_path):
    path = dataset(tmp_path / "set")
    found = find(path, ImportOptions(images={"scope": "observation.images.endoscope.right"}))
    assert [camera.name for camera in found.cameras] == ["scope"]
    with pytest.raises(CartsError, match=r"has no video 'x'\. It has: observation"):
        find(path, ImportOptions(images={"scope": "x"}))
