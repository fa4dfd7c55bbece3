"""`carts train --for`: a network is adapted to the robots, cameras and distances of a recording."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from carts_core.cli.command_line import BAD_INPUT, main
from carts_core.errors import SettingsError
from carts_core.lab.randomization.arms import RecordedPlacements, RobotGeometry
from carts_core.lab.training.adaptation import BACKGROUNDS, STEPS, Fits, Judgement, adapted_to, synthetic_images
from carts_core.lab.training.loader import validation_set
from carts_core.lab.training.loop import load_checkpoint
from carts_core.lab.training.tasks import SurfaceTask, dice, pooled_dice, tip_error
from carts_core.lab.training.training import train
from carts_core.model.robot import Robot
from carts_core.networks.weights import read_weights
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence, shipped_weights
from carts_core.settings import ImageSettings, TrainingConfig
from carts_core.settings.training import ADAPTATION_SETTINGS

ARM = """<robot name="arm"><link name="base"/>
<link name="upper"><visual><origin xyz="0 0 0.3"/><geometry><box size="0.1 0.1 0.6"/></geometry></visual></link>
<link name="lower"><visual><origin xyz="0 0 0.2"/><geometry><box size="0.08 0.08 0.4"/></geometry></visual></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.6"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""
SEQUENCE = """format = "carts-sequence/1"
[kinematics]
table = "kinematics.csv"
[[cameras]]
name = "overview"
images = "{frame}.png"
size = [64, 48]
K = { fx = 70.0, fy = 70.0, cx = 32.0, cy = 24.0 }
T_camera_world = [[1, 0, 0, 0], [0, 0, -1, 0.5], [0, 1, 0, 1.5], [0, 0, 0, 1]]
[[arms]]
name = "arm"
robot = "arm.urdf"
[arms.joints]
shoulder = "shoulder"
elbow = "elbow"
"""


SMALL = ImageSettings(width=64, height=48, field_width=80)


@pytest.fixture
def far_away(tmp_path: Path) -> Path:
    """A recording of a robot that is 1.5 m away."""
    (tmp_path / "arm.urdf").write_text(ARM)
    (tmp_path / "sequence.toml").write_text(SEQUENCE)
    for frame in range(4):
        cv2.imwrite(str(tmp_path / f"{frame}.png"), np.zeros((48, 64, 3), np.uint8))
    rows = [f"{frame},{0.1 * frame},{-0.2 * frame}" for frame in range(4)]
    (tmp_path / "kinematics.csv").write_text("\n".join(["frame,shoulder,elbow", *rows]) + "\n")
    return tmp_path / "sequence.toml"


def test_arms_are_placed_at_the_distance_of_the_recording_and_in_the_image(far_away: Path):
    robot = Robot.load(far_away.parent / "arm.urdf")
    geometry = RobotGeometry(robot)
    placements, rng = RecordedPlacements(far_away), np.random.default_rng(0)
    distances, inside = [], 0
    for _ in range(40):
        (fx, fy, cx, cy), (placement,) = placements(rng, (geometry,), (48, 32), 80)
        assert 0.6 < fx / 80 / (70 / 64) < 1.6
        Ts = placement.T_camera_base @ geometry.link_transforms(placement.joint_positions)
        x, y, z = geometry.posed(Ts).vertices.T
        distances.append(np.median(z))
        u, v = fx * x / z + cx, fy * y / z + cy
        inside += bool(((u > 0) & (u < 48) & (v > 0) & (v < 32)).any())
        low, high = robot.joint_limits.T
        assert ((placement.joint_positions >= low) & (placement.joint_positions <= high)).all()
    assert 1.2 < np.median(distances) < 1.9
    assert inside == 40


def test_arms_are_placed_in_front_of_a_moving_camera_as_in_front_of_a_fixed_one(far_away: Path):
    def drawn() -> list[np.ndarray]:
        geometry, rng = RobotGeometry(Robot.load(far_away.parent / "arm.urdf")), np.random.default_rng(0)
        placements = RecordedPlacements(far_away)
        return [placements(rng, (geometry,), (48, 32), 80)[1][0].T_camera_base for _ in range(8)]

    fixed, text = drawn(), far_away.read_text()
    T_camera_world = Sequence.open(far_away).scene.cameras[0].T_camera_world
    T_world_mount = np.array([[0, 0, 1, 0.3], [1, 0, 0, -0.8], [0, 1, 0, 0.5], [0, 0, 0, 1]])
    poses = [f"{frame},0.3,-0.8,0.5,0.5,0.5,0.5,0.5" for frame in range(4)]
    (far_away.parent / "ecm.csv").write_text("\n".join(["frame,x,y,z,qx,qy,qz,qw", *poses]) + "\n")
    given = next(line for line in text.splitlines() if line.startswith("T_camera_world"))
    moving = f'T_camera_world = {(T_camera_world @ T_world_mount).tolist()}\nmotion = "ecm.csv"'
    far_away.write_text(text.replace(given, moving))
    np.testing.assert_allclose(drawn(), fixed, atol=1e-9)


def test_a_robot_that_is_not_of_the_recording_is_refused(far_away: Path):
    with pytest.raises(SettingsError, match="not one of the recording's"):
        RecordedPlacements(far_away)(
            np.random.default_rng(0), (RobotGeometry(Robot.load("builtin:psm_lnd")),), (48, 32), 80
        )


def test_settings_come_from_the_recording_and_the_shipped_weights_unless_they_are_given(tmp_path: Path):
    config = adapted_to(sample_sequence(), tmp_path, ADAPTATION_SETTINGS)
    assert config.start == shipped_weights()[1]
    assert (config.steps, config.minutes) == (STEPS, None)
    assert [path.name for path in config.robots] == ["psm_lnd.urdf"]
    assert config.images.recording == sample_sequence().absolute()
    assert config.images.photographs == tmp_path / BACKGROUNDS
    cameras = len(Sequence.open(sample_sequence()).scene.cameras)
    assert len(list((tmp_path / BACKGROUNDS).glob("*.png"))) == cameras
    given = replace(ADAPTATION_SETTINGS, minutes=3.0, learning_rate=1e-4, start=Path("other.safetensors"))
    config = adapted_to(sample_sequence(), tmp_path, given)
    assert (config.minutes, config.learning_rate, config.start) == (3.0, 1e-4, Path("other.safetensors"))


def test_given_options_are_kept_and_those_that_cannot_apply_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    taken: list[TrainingConfig] = []

    def train(config: TrainingConfig, *_: object):
        taken.append(config)
        raise SettingsError("enough")

    def run(options: str) -> str:
        with pytest.raises(SystemExit):
            main(["train", str(tmp_path / "run"), f"--for={sample_sequence()}", *options.split()])
        return " ".join(capsys.readouterr().err.split())

    with monkeypatch.context() as patch:
        patch.setattr("carts_core.lab.training.training.train", train)
        run("--patience 20 --steps 4000 --warmup 100 --validation-every 250 --images.photographs mine")
    (config,) = taken
    assert (config.patience, config.steps, config.warmup, config.validation_every) == (20, 4000, 100, 250)
    assert (config.images.photographs, config.images.from_photographs) == (Path("mine"), 0.5)
    assert (config.learning_rate, config.average, config.validation_samples) == (6e-4, 0.97, 48)
    assert "network is 'feature'" in run("--network feature")


def test_a_missing_recording_is_named_and_leaves_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["train", str(tmp_path / "run"), "--for", str(tmp_path / "none.toml")])
    assert ended.value.code == BAD_INPUT and not (tmp_path / "run").exists()
    assert "none.toml is missing" in " ".join(capsys.readouterr().err.split())


@pytest.fixture
def config(tiny_sequence: Callable[..., Path], tmp_path: Path) -> TrainingConfig:
    """A run of one step that is adapted to a tiny recording."""
    given = replace(
        ADAPTATION_SETTINGS, workers=0, threads=1, batch_size=1, validation_samples=1, steps=1, images=SMALL
    )
    return adapted_to(tiny_sequence(), tmp_path / "adapted", given)


@pytest.mark.slow
def test_early_stopping_keeps_the_best_weights(config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(SurfaceTask, "worse", lambda *_: False)
    # At so small a rate only the batch statistics change.
    config = replace(config, steps=STEPS, learning_rate=1e-12, weight_decay=0.0, patience=2, average=0.0,
                     validation_every=1)  # fmt: skip
    result = train(config, tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None
    scores = [entry["dice"] for entry in checkpoint.history.validations]
    assert checkpoint.history.validations[0]["step"] == 0
    assert max(scores[:-2]) == result.validation["dice"]
    assert len(scores) == 1 + scores.index(max(scores)) + 2
    assert read_weights(result.weights).training["step"] == result.validation["step"]
    again = train(config, tmp_path)
    assert again.validation == result.validation
    assert again.first == result.first == checkpoint.history.validations[0]


def test_another_recording_of_the_same_name_does_not_resume_the_run(
    config: TrainingConfig, tiny_sequence: Callable[..., Path], tmp_path: Path
):
    train(config, tmp_path / "adapted")
    before = {path: path.read_bytes() for path in (tmp_path / "adapted").rglob("*.*")}
    recording = tiny_sequence()
    table, image = recording.parent / "kinematics.csv", recording.parent / "regular" / "left" / "001.png"
    table.write_text(table.read_text().replace("0.15", "0.16"))
    cv2.imwrite(str(image), np.zeros((72, 96, 3), np.uint8))
    with pytest.raises(SettingsError, match=r"other settings: recording_digest was \w+ and is \w+\. .* another output"):
        adapted_to(recording, tmp_path / "adapted", ADAPTATION_SETTINGS)
    assert {path: path.read_bytes() for path in (tmp_path / "adapted").rglob("*.*")} == before


FIGURES = {"dice": 0.8, "dice_given": 0.5, "part_accuracy": 0.9, "normal_error_deg": 20.0, "tip_error": 2.7}
FIGURES |= dict.fromkeys(("dice_shaft", "dice_wrist", "dice_jaws"), 0.7)


@pytest.mark.parametrize(
    ("worse", "kept"), [({}, 1), ({"tip_error": 10.9}, 0), pytest.param({"dice_jaws": 0.6}, 0, marks=pytest.mark.slow)]
)
def test_weights_with_better_masks_and_worse_tips_or_parts_are_not_kept(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, worse: dict[str, float], kept: int
):
    figures = iter([FIGURES, {**FIGURES, "dice": 0.9, **worse}])
    monkeypatch.setattr(SurfaceTask, "validate", lambda *_: next(figures))
    result = train(config, tmp_path)
    assert result.validation["step"] == kept
    assert read_weights(result.weights).training["step"] == kept


def test_a_validation_lost_to_a_stop_is_made_up_for(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def stopped() -> dict[str, float]:
        raise KeyboardInterrupt

    figures = iter([lambda: FIGURES, stopped, lambda: {**FIGURES, "dice": 0.9}])
    monkeypatch.setattr(SurfaceTask, "validate", lambda *_: next(figures)())
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path)
    assert read_weights(tmp_path / "surface.safetensors").training["step"] == 0
    result = train(config, tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None and [entry["step"] for entry in checkpoint.history.validations] == [0, 1]
    assert read_weights(result.weights).training["step"] == result.validation["step"] == 1


def test_making_validation_images_is_no_training_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = TrainingConfig(workers=0, threads=1, batch_size=1, validation_samples=1, steps=2, minutes=10, images=SMALL)
    train(config, tmp_path)
    burnt, clock = [0.0], time.process_time

    def slow_validation_set(config: TrainingConfig):
        burnt[0] += 1000.0
        return validation_set(config)

    monkeypatch.setattr("carts_core.lab.training.loop.time.process_time", lambda: clock() + burnt[0])
    monkeypatch.setattr("carts_core.lab.training.training.validation_set", slow_validation_set)
    train(replace(config, steps=4), tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None and checkpoint.step == 4


def test_minutes_are_processor_time(config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = iter(range(0, 10**9, 1000))
    monkeypatch.setattr("carts_core.lab.training.loop.time.perf_counter", lambda: float(next(clock)))
    train(replace(config, steps=3, minutes=5.0), tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    assert checkpoint is not None and checkpoint.step == 3
    assert checkpoint.history.seconds > 60 * 5.0 > checkpoint.history.processor_seconds > 0.0


def test_the_tip_is_the_end_of_the_jaws():
    surface = torch.zeros(2, 6, 20, 30)
    surface[:, 0, 8:12, 0:10] = 1.0
    surface[:, 2, 9:11, 10:20] = 1.0
    seen = surface.clone()
    seen[0, 2, :, 17:] = 0.0
    assert tip_error(surface, surface) == 0.0
    assert tip_error(seen, surface) == pytest.approx(1.5, abs=0.3)
    seen[1, 2] = 0.0
    assert tip_error(seen, surface) == pytest.approx((3.0 + 20.0) / 2, abs=0.3)


def _judgement(moved: float = 0.0, **now: float) -> Judgement:
    before = Fits(0.97, 0.95, 2.7, 4, 2.0, 0.7, (np.array([[10.0, 10.0], [np.nan, np.nan]]),))
    return Judgement(before, replace(before, tips=(before.tips[0] + moved,), **now))


@pytest.mark.parametrize(
    ("judgement", "worse"),
    [
        (_judgement(), []),
        (_judgement(dice=0.98, made_tips=2.0, edges=2.2, moved=5.0), []),
        (_judgement(dice=0.98, made_tips=10.9), ["tip error in synthetic images (2.7 -> 10.9 px)"]),
        (_judgement(dice=0.96), ["masks in synthetic images (Dice 0.970 -> 0.960)"]),
        (_judgement(made_parts=0.9), ["part accuracy in synthetic images (0.950 -> 0.900 of the pixels)"]),
        (_judgement(good=3), ["verdicts on the recording (4 -> 3 good)"]),
        (_judgement(parts=0.1), ["predicted parts in the recording (0.700 -> 0.100 of the pixels)"]),
        (_judgement(edges=1.5), ["edge strength in the recording (2.00 -> 1.50)"]),
        (_judgement(moved=5.0), ["tips in the recording (moved by 7.1 px without stronger edges)"]),
    ],
)
def test_what_is_worse_is_named(judgement: Judgement, worse: list[str]):
    assert judgement.worse() == worse


@pytest.mark.parametrize("tips", [2.0, 10.9])
def test_weights_are_offered_only_where_nothing_is_worse(
    tiny_sequence: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tips: float,
):
    monkeypatch.setattr("carts_core.lab.training.adaptation.judge", lambda *_, **__: _judgement(made_tips=tips))
    small = "--steps 1 --batch-size 1 --workers 0 --threads 1 --validation-samples 1"
    small += " --images.width 64 --images.height 48 --images.field-width 80"
    main(["train", str(tmp_path / "run"), "--for", str(tiny_sequence()), *small.split()])
    said = " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "run" / "surface.safetensors").is_file() == (tips == 2.0)
    assert (tmp_path / "run" / "refused.safetensors").is_file() == (tips == 10.9)
    assert ("To use them: carts optimize" in said) == (tips == 2.0)
    assert ("rejected because of worse results: tip error in synthetic images (2.7 -> 10.9 px)" in said) == (
        tips == 10.9
    )


@pytest.mark.slow
def test_made_images_to_judge_by_are_whole_and_always_the_same(tmp_path: Path):
    config = adapted_to(sample_sequence(), tmp_path, ADAPTATION_SETTINGS)
    (first,), (again,) = (list(synthetic_images(config, 1)) for _ in range(2))
    assert first.frame.images["made"].shape == (240, 320, 3)
    assert np.array_equal(first.frame.images["made"], again.frame.images["made"])
    for arm in first.scene.arms:
        assert first.frame.truth is not None
        off = np.abs(first.frame.measured[arm.name] - first.frame.truth[arm.name])
        assert off[0] == pytest.approx(np.deg2rad(2.0), abs=1e-3)


def test_one_wrong_pixel_where_no_arm_is_hardly_changes_the_score():
    truth = torch.zeros(4, 40, 50, dtype=torch.bool)
    truth[:3, 10:30, 10:30] = True
    predicted = truth.clone()
    assert pooled_dice(predicted, truth) == 1.0
    predicted[3, 0, 0] = True
    assert float(dice(predicted, truth).mean()) == pytest.approx(0.75) and pooled_dice(predicted, truth) > 0.999
    predicted[3] = True
    assert pooled_dice(predicted, truth) == pytest.approx(2 * 1200 / (1200 + 1200 + 2000))
