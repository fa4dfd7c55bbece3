"""Synthetic sequences: a small one, one of another robot, and the shipped one."""

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch

from carts_core.errors import SettingsError
from carts_core.evaluation import dice
from carts_core.lab.benchmark.hand_eye import ARM
from carts_core.lab.synthesis import DOMAINS, EndoscopeConfig, MotionConfig, RenderConfig, SynthesisConfig, synthesize
from carts_core.recording import Sequence
from carts_core.rendering import Renderer


def _files(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _overlap(sequence: Sequence, frame: int, camera: str, positions: dict[str, np.ndarray]) -> float:
    renderer, masks = Renderer(sequence.scene, cameras=[camera]), sequence.frame(frame).masks
    assert masks is not None
    return dice(renderer.segment(sequence.scene.state(positions))[0] >= 0, masks[camera])


def test_truth_masks_are_those_of_the_true_kinematics_and_measured_ones_are_off(small_sequence: Path) -> None:
    sequence = Sequence.open(small_sequence)
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        assert frame.truth is not None
        for camera in ("left", "right"):
            true, measured = (_overlap(sequence, index, camera, each) for each in (frame.truth, frame.measured))
            assert true > 0.97
            assert measured < true - 0.02


def test_each_domain_is_what_its_name_says(small_sequence: Path) -> None:
    sequence = Sequence.open(small_sequence)
    images = {domain: sequence.frame(0, domain).images["left"].astype(float) for domain in DOMAINS}
    regular = images["regular"]
    for domain in DOMAINS[1:]:
        assert np.abs(images[domain] - regular).mean() > 5.0, domain
    assert images["low_brightness"].mean() < 0.7 * regular.mean()
    redness = {domain: image[..., 0].mean() / image[..., 1].mean() for domain, image in images.items()}
    assert redness["bleeding"] > 1.15 * redness["regular"]
    for hazy in ("smoke", "simulated_smoke"):
        assert redness[hazy] < 0.9 * redness["regular"]


def test_a_stopped_synthesis_is_resumed(small_config: SynthesisConfig, small_sequence: Path, tmp_path: Path) -> None:
    config, output = dataclasses.replace(small_config, domains=("smoke",)), tmp_path / "sequence"
    calls: list[tuple[str, int]] = []

    def stop_after_one(what: str, done: int, total: int) -> None:
        calls.append((what, done))
        if what == "frames" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize(config, output, stop_after_one)
    assert not output.exists()
    (partial,) = tmp_path.glob(".carts-*")
    first = Path("images", "smoke", "left", "001.jpg")
    written = (partial / "sequence" / first).stat().st_mtime_ns
    synthesize(config, output)
    assert (output / first).stat().st_mtime_ns == written
    assert [path.name for path in tmp_path.iterdir()] == ["sequence"]
    made, all_files = _files(output), _files(small_sequence.parent)
    assert {name.split("/")[1] for name in made if name.startswith("images")} == {"smoke"}
    assert len(made) == 2 * 2 * 2 + 3
    assert all(made[name] == all_files[name] for name in made if name != "sequence.toml")
    assert calls == [("tissue, robots and motion", 0), ("frames", 1)]


def test_a_folder_with_something_in_it_is_never_touched(small_config: SynthesisConfig, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(SettingsError, match=r"exists\. Choose"):
        synthesize(small_config, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_the_shipped_sequence_is_complete_and_its_masks_fit_the_truth(sample_sequence_path: Path) -> None:
    sequence, folder = Sequence.open(sample_sequence_path), sample_sequence_path.parent
    assert sequence.domains == DOMAINS and len(sequence) >= 24
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 9_000_000
    assert not list(folder.rglob(".*"))
    for index in range(0, len(sequence), 12):
        frame = sequence.frame(index)
        assert frame.truth is not None
        assert _overlap(sequence, index, "left", frame.truth) > 0.985
        assert _overlap(sequence, index, "left", frame.measured) < 0.95


DISTANCE = 1.6


def _config(robot: Path, **settings) -> SynthesisConfig:
    return SynthesisConfig(
        seed=4,
        robot=robot,
        domains=("regular", "smoke"),
        endoscope=EndoscopeConfig(width=96, height=72, distance=DISTANCE),
        motion=MotionConfig(frames=2, frame_rate=2.0),
        render=RenderConfig(samples=1, tissue_resolution=64, texture_resolution=128),
        **settings,
    )


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    folder = tmp_path_factory.mktemp("arm")
    return Sequence.open(synthesize(_config(ARM), folder / "sequence"))


def test_one_arm_is_seen_from_so_far_and_its_masks_are_those_of_the_true_joints(sequence: Sequence) -> None:
    (arm,) = sequence.scene.arms
    renderer = Renderer(sequence.scene)
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        assert frame.masks is not None and frame.truth is not None
        assert 0.02 < frame.masks["left"].mean() < 0.6
        true, measured = (
            dice(renderer.segment(sequence.scene.state(joints))[0] >= 0, frame.masks["left"])
            for joints in (frame.truth, frame.measured)
        )
        assert true > 0.97 and measured < true
        assert (np.abs(frame.truth["arm"] - frame.measured["arm"]) > 0.005).all()
        low, high = arm.robot.joint_limits.T
        assert (frame.truth["arm"] > low).all() and (frame.truth["arm"] < high).all()
        T_camera_base = sequence.scene.cameras[0].T_camera_world @ arm.T_world_base
        tip = arm.robot.forward_kinematics(torch.from_numpy(frame.truth["arm"]))[-1].numpy()
        assert 0.5 * DISTANCE < (T_camera_base @ tip)[2, 3] < 1.4 * DISTANCE, "in metres, and not in the small world's"


@pytest.mark.parametrize("distance", [DISTANCE, 0.2])
def test_an_instrument_is_not_looked_at_from_afar(tmp_path: Path, distance: float) -> None:
    config = dataclasses.replace(_config(SynthesisConfig().robot), endoscope=EndoscopeConfig(distance=distance))
    with pytest.raises(SettingsError, match=r"surgical instrument\. The limit for instruments is 0\.16 m"):
        synthesize(config, tmp_path / "sequence")
