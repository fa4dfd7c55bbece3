"""The examples of docs/reference/sequence_format.md are sequences that open."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from videos import write_video

from carts_core.recording import Sequence
from carts_core.recording.matching import TimeMatching
from carts_core.resources import shipped_robot

DOCUMENT = Path(__file__).parents[2] / "docs" / "reference" / "sequence_format.md"
ARMS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
FRAMES = 2
IMAGE = np.full((720, 1280, 3), 90, np.uint8)


def example(number: int) -> str:
    return re.findall(r"```toml\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)[number]


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_table(path: Path, columns: list[str], value: str) -> None:
    rows = [f"{row + 1:04d},{row / 10}," + ",".join([value] * len(columns)) for row in range(FRAMES)]
    path.write_text("\n".join(["frame,time," + ",".join(columns), *rows]) + "\n")


def test_the_smallest_example_opens_with_the_table_that_is_printed_beside_it(tmp_path):
    (tmp_path / "sequence.toml").write_text(example(0))
    table = re.findall(r"^ {4}(frame,q1.*|\d{4},.*)$", DOCUMENT.read_text(), re.MULTILINE)
    (tmp_path / "kinematics.csv").write_text("\n".join(table))
    for frame in ("0001", "0002"):
        write_image(tmp_path / "left" / f"{frame}.png", IMAGE[:480, :640])
    sequence = Sequence.open(tmp_path / "sequence.toml")
    assert sequence.frame_ids == ("0001", "0002")
    assert sequence.frame(1).measured["PSM1"][0] == -0.063554


@pytest.fixture
def complete_example(tmp_path) -> Path:
    """The complete example with every file that it points at."""
    folder = tmp_path / "recording"
    folder.mkdir()
    (folder / "sequence.toml").write_text(example(1))
    psm1 = [f"psm1_q{number}" for number in range(1, 7)] + ["psm1_jaw"]
    psm2 = [name if name != "insertion" else "depth" for name in ARMS]
    for prefix, columns, value in (("", psm1, "0.1"), ("psm2_", psm2, "30")):
        for kind in ("truth", "kinematics" if not prefix else ""):
            write_table(folder / f"{(prefix + kind).strip('_')}.csv", columns, value)
    shutil.copytree(shipped_robot().parent, tmp_path / "robots")
    (tmp_path / "robots" / shipped_robot().name).rename(tmp_path / "robots" / "prograsp.urdf")
    camera = {"K": [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], "T_camera_world": np.eye(4).tolist()}
    (folder / "calibration.json").write_text(json.dumps({"left": camera, "right": camera}))
    for frame in range(1, FRAMES + 1):
        for domain in ("regular", "smoke"):
            write_image(folder / domain / "left" / f"{frame:04d}.jpg", IMAGE)
        write_image(folder / "smoke" / f"right_{frame}.png", IMAGE)
    write_image(folder / "masks" / "left" / "0001.png", IMAGE[..., 0] * 0)
    write_image(folder / "empty_left.png", IMAGE)
    write_image(folder / "empty_right_smoke.png", IMAGE)
    video = cv2.VideoWriter(str(folder / "right.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (1280, 720))
    for _ in range(FRAMES):
        video.write(IMAGE)
    video.release()
    return folder / "sequence.toml"


def test_the_complete_example_opens_and_means_what_its_comments_say(complete_example):
    sequence = Sequence.open(complete_example)
    assert sequence.frame_ids == ("0001", "0002")
    psm1, psm2 = sequence.scene.arms
    assert sequence.measured_joints["PSM1"] == psm1.robot.joint_names
    assert sequence.measured_joints["PSM2"] == ARMS
    assert psm2.T_world_base[0, 3] == 0.12
    values = dict(zip(psm2.robot.joint_names, sequence.measured["PSM2"][0], strict=True))
    assert values["yaw"] == pytest.approx(np.pi / 6)
    assert values["insertion"] == pytest.approx(0.030 + 0.0156)
    assert values["jaw"] == 0.3
    assert sequence.scene.camera("left").intrinsics == (1000.0, 1000.0, 640.5, 360.5)
    for domain in sequence.domains:
        frame = sequence.frame(0, domain)
        assert frame.masks is not None and set(frame.masks) == {"left"}
        assert all(abs(int(image[300, 600, 0]) - 90) < 4 for image in frame.images.values())
    assert sequence.frame(1).masks is None
    assert sequence.background("right", "smoke").mean() == 90


def test_the_example_with_a_log_of_its_own_reads_it_at_the_times_of_the_video(tmp_path):
    (tmp_path / "sequence.toml").write_text(example(2))
    write_video(tmp_path / "left.mp4", [IMAGE[:480, :640]] * 3, milliseconds=[1500, 1540, 1640])
    stamps = np.arange(1.0, 2.0, 0.01)
    rows = [f"{stamp!r},{stamp!r},0.1,0.15,0.1,0.1,0.1" for stamp in stamps.tolist()]
    (tmp_path / "measured_js.csv").write_text("\n".join(["stamp,q1,q2,q3,q4,q5,q6", *rows]))
    sequence = Sequence.open(tmp_path / "sequence.toml")
    assert sequence.matching == TimeMatching(-0.035, "linear", 0.1)
    assert sequence.measured["PSM1"][:, 0] == pytest.approx([1.465, 1.505, 1.605])
    assert sequence.frame_ids == ("0", "1", "2")
    # What is commented out works, too.
    text = (
        example(2).replace('video = "left.mp4"', "").replace("# table =", "table =").replace("# timestamp", "timestamp")
    )
    (tmp_path / "sequence.toml").write_text(text)
    (tmp_path / "left_times.csv").write_text("frame,timestamp\na,1.5\nb,1.6\nc,1.7\n")
    assert Sequence.open(tmp_path / "sequence.toml").measured["PSM1"][:, 0] == pytest.approx([1.465, 1.565, 1.665])
