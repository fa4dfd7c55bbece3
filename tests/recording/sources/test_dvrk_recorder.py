"""Sessions laid out as the dVRK's recorder writes them: side-by-side videos, sidecars, a bag or extracted CSV files."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import SIZE, START, BagKind, assert_refused, copied, image, joints_at, pose_of, remove, write, write_bag
from videos import write_video

from carts_core.cli import main
from carts_core.model.psm_kinematics import forward
from carts_core.recording import Sequence
from carts_core.recording.importing.importer import find, import_recording

FRAMES = 6
RATE = 12.5


def entry(index: int, **realtime: int) -> dict[str, Any]:
    """A frame of a sidecar by the recorder's schema; the recorder receives it 30 ms late."""
    time = START + round(index * 1e9 / RATE)
    known = {f"{key}_ns": time + shift for key, shift in realtime.items()}
    gst = dict.fromkeys(("pts_ns", "dts_ns", "duration_ns", "running_time_ns", "stream_time_ns", "clock_time_ns"), 0)
    cpu = {"realtime": {**known, "recorder_reception_ns": time + 30_000_000}, "monotonic": {"recorder_reception_ns": 1}}
    return {"frame_index": index, "gst": gst, "cpu": cpu}


def sidecar(frames: list[dict[str, Any]], layout: str, latency: float | None) -> dict[str, Any]:
    return {
        "type": "dvrk_data:video_sidecar@1.0.0",
        "video_file": "stereo.mp4",
        "stream_name": "stereo",
        "frames_recorded": len(frames),
        "frames_dropped": 0,
        "side_by_side": layout,
        "estimated_latency_ms": latency,
        "frames": frames,
    }


def session(
    folder: Path, layout: str = "LR", latency: float | None = None, realtime: dict[str, int] | None = None
) -> Path:
    """A session with one side-by-side video and a bag without images."""
    order = ("left", "right") if layout != "RL" else ("right", "left")
    pictures = [np.concatenate([image(number, side) for side in order], 1) for number in range(FRAMES)]
    write_video(folder / "stereo.mp4", pictures, rate=30)
    shift = {"left_source": -1_000_000, "right_source": 1_000_000} if realtime is None else realtime
    frames = [entry(index, **shift) for index in range(FRAMES)]
    (folder / "stereo.json").write_text(json.dumps(sidecar(frames, layout, latency)))
    write_bag(folder / "rosbag_session", BagKind(storage="mcap", cameras=()))
    videos = [{"file": "stereo.mp4", "duration": 0.5}]
    (folder / "index.json").write_text(
        json.dumps({"videos": videos, "rosbag": {"name": "rosbag_session", "duration": 1}})
    )
    return folder


@pytest.mark.parametrize("layout", ["LR", "RL"])
def test_a_side_by_side_session_becomes_two_cameras_by_one_command(tmp_path, layout):
    path = session(tmp_path / "session", layout)
    main(["import", str(path), "-o", str(tmp_path / "out")])
    sequence = Sequence.open(tmp_path / "out/sequence.toml")
    assert [(camera.name, camera.width) for camera in sequence.scene.cameras] == [("left", SIZE[0]), ("right", SIZE[0])]
    assert len(sequence) == FRAMES
    for index in (5, 0, 3):
        frame = sequence.frame(index)
        for side in ("left", "right"):
            assert np.abs(frame.images[side].astype(int) - image(index, side)).mean() < 6
        # The video runs at 30 frames a second; the sidecar's times are what counts.
        assert np.abs(frame.measured["PSM1"][:6] - joints_at(index / RATE)).max() < 2e-3


@pytest.mark.parametrize(
    ("realtime", "late"),
    [
        ({"mono_source": 5_000_000, "left_source": 9_000_000, "right_source": 9_000_000}, 0.005),
        ({"left_source": 2_000_000, "right_source": 6_000_000}, 0.004),
        ({"left_source": 2_000_000}, 0.002),
        ({"right_source": 7_000_000}, 0.007),
        ({}, 0.030),
    ],
    ids=["mono", "middle of left and right", "left", "right", "reception"],
)
def test_the_time_of_a_frame_follows_the_recorders_rule(tmp_path, realtime, late):
    found = find(session(tmp_path / "session", realtime=realtime))
    assert found.frame_times is not None
    assert found.frame_times[1] - START * 1e-9 == pytest.approx(1 / RATE + late, abs=1e-6)


def test_the_estimated_latency_is_offered_as_the_time_offset(tmp_path):
    found = find(session(tmp_path / "session", latency=35.0))
    assert found.time_offset == pytest.approx(-0.035)
    assert any(note.kind == "guessed" and "estimated latency" in str(note) for note in found.notes)


def test_frames_are_found_by_their_number_when_the_recorder_dropped_some(tmp_path):
    path = session(tmp_path / "session")
    content = json.loads((path / "stereo.json").read_text())
    content["frames"] = [frame for frame in content["frames"] if frame["frame_index"] != 2]
    content["frames_dropped"] = 1
    (path / "stereo.json").write_text(json.dumps(content))
    file, found = import_recording(path, tmp_path / "out")
    frame = Sequence.open(file).frame(2)
    assert np.abs(frame.images["left"].astype(int) - image(3)).mean() < 6
    assert any("dropped 1 frames" in str(note) for note in found.notes)


@pytest.mark.parametrize(("key", "unit"), [("timestamps_ns", 1), ("timestamps_ms", 1e-6), ("timestamps", 1e-9)])
def test_older_sidecars_and_extracted_tables_are_read(tmp_path, key, unit):
    folder = tmp_path / "session"
    write_video(folder / "left.mp4", [image(number) for number in range(FRAMES)])
    stamps = [(START + round(index * 1e9 / RATE)) * unit for index in range(FRAMES)]
    (folder / "left.json").write_text(json.dumps({"video_file": "left.mp4", key: stamps}))
    times = np.arange(-5, 60) / 100
    for topic, header, values in (
        ("measured_js", [f"position.{index}" for index in range(6)], joints_at(times)),
        (
            "measured_cp",
            [*(f"pose.position.{a}" for a in "xyz"), *(f"pose.orientation.{a}" for a in "xyzw")],
            np.array([pose_of(T) for T in forward(joints_at(times))]),
        ),
    ):
        rows = [
            ",".join([str(START + round(time * 1e9)), *map(repr, map(float, row))])
            for time, row in zip(times, values, strict=True)
        ]
        head = [f"# Topic: /PSM1/{topic}", "# Type: sensor_msgs/msg/JointState", ",".join(["timestamp", *header])]
        (folder / f"_PSM1_{topic}.csv").write_text("\n".join([*head, *rows]) + "\n")
    file, found = import_recording(folder, tmp_path / "out")
    sequence = Sequence.open(file)
    assert np.abs(sequence.frame(4).measured["PSM1"][:6] - joints_at(4 / RATE)).max() < 2e-3
    assert any("9.1 mm wrist" in str(note) for note in found.notes)


def changed(change: Callable[[dict[str, Any]], object], name: str = "stereo.json") -> Callable[[Path], object]:
    def mutate(path: Path) -> None:
        content = json.loads((path / name).read_text())
        change(content)
        (path / name).write_text(json.dumps(content))

    return mutate


MUTATIONS: dict[str, tuple[Callable[[Path], object], str]] = {
    "index is cut": (write("index.json", '{"videos": ['), "index.json is not readable JSON"),
    "index lists nothing": (write("index.json", '{"videos": 3}'), 'no list "videos"'),
    "no videos": (changed(lambda c: c.update(videos=[]), "index.json"), "no videos with sidecars"),
    "video is missing": (remove("stereo.mp4"), r"stereo\.mp4 is missing"),
    "sidecar is missing": (remove("stereo.json"), "stereo.json with the frame times of stereo.mp4 is missing"),
    "sidecar is cut": (write("stereo.json", '{"frames": [{'), "stereo.json is not readable"),
    "no frames": (changed(lambda c: c.update(frames=[])), 'neither "frames" nor'),
    "frames without numbers": (changed(lambda c: c["frames"][1].pop("frame_index")), "'frame_index' is missing"),
    "frames without times": (changed(lambda c: c["frames"][1].pop("cpu")), "'cpu' is missing"),
    "unknown layout": (changed(lambda c: c.update(side_by_side="TB")), "side_by_side is 'TB'"),
    "another video": (changed(lambda c: [f.update(frame_index=900) for f in c["frames"]]), "belongs to another video"),
    "texts as times": (changed(lambda c: c.update(timestamps_ns=["a"])), "times are not numbers"),
    "no bag": (lambda p: shutil.rmtree(p / "rosbag_session"), "has no kinematics: neither a bag"),
    "cut bag": (
        lambda p: [f.write_bytes(f.read_bytes()[:3000]) for f in (p / "rosbag_session").glob("*.mcap")],
        "rosbag_session",
    ),
    "another clock": (
        changed(lambda c: [f["cpu"].update(realtime={"recorder_reception_ns": 10**9}) for f in c["frames"]]),
        "no frame has joint positions",
    ),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_broken_session_is_an_error_in_words_and_leaves_nothing(tmp_path, name):
    mutate, message = MUTATIONS[name]
    path = copied(session, tmp_path / "session")
    mutate(path)
    assert_refused(path, message)
