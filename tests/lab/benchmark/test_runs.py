"""Planned runs, their measurements and the file of results."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from handmade import make_measurement
from tiny import tiny_scene

from carts_core.errors import SettingsError
from carts_core.files import output_path
from carts_core.lab.benchmark import FULL, QUICK, Measurement, ResultsFile, Run, Score, Source, hand_eye, plan
from carts_core.lab.benchmark.frame import start_of, tip_depth_error_mm
from carts_core.lab.benchmark.hand_eye import CONDITIONS, HandEyeRun, known_hand_eye, measure_hand_eye
from carts_core.lab.synthesis import DOMAINS
from carts_core.model.robot import Robot
from carts_core.networks.extractor import FeatureExtractor
from carts_core.recording import Sequence

METHODS = ("unet", "start", "l1", "paper", "ours", "ours_refined")


def _source(name: str, frames: list[int], cameras: tuple[str, ...] = ("left",)) -> Source:
    def never(_: object) -> Sequence:
        raise AssertionError("a plan opens nothing")

    return Source(name, "", "left", frames, "", never, cameras, [0, 1])


BOTH = [_source("synthetic", [0, 2]), _source("real", [5], ("left", "right"))]


@pytest.mark.parametrize("scope", [QUICK, FULL])
def test_no_run_is_planned_twice_and_the_main_table_is_complete(scope) -> None:
    runs = plan(scope, BOTH)
    assert len(set(runs)) == len(runs)
    for source, frame in (("synthetic", 0), ("synthetic", 2), ("real", 5)):
        for domain in DOMAINS:
            for method in METHODS:
                assert Run(source, domain, frame, method) in runs


def test_frame_comes_after_frame_so_that_a_stopped_benchmark_has_some_of_everything() -> None:
    runs = plan(FULL, BOTH)
    alone = [run for run in runs if run.method not in ("sequence", "temporal")]
    assert runs[: len(alone)] == alone
    by_all = [run for run in alone if (run.source, run.frame) in (("synthetic", 0), ("synthetic", 2), ("real", 5))]
    assert runs[: len(by_all)] == by_all
    first = [run for run in by_all if (run.source, run.frame) != ("synthetic", 2)]
    assert runs[: len(first)] == first


@pytest.mark.parametrize("frames", [0, 25])
def test_more_frames_than_there_are_is_an_error_that_says_how_many_may_be_asked_for(frames: int) -> None:
    with pytest.raises(SettingsError, match=f"--frames is {frames}; .* Give 1 to {FULL.sequence_frames}"):
        FULL.with_frames(frames)


def test_a_torn_last_line_is_left_out_and_does_not_swallow_the_next(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    first, second, third = (make_measurement((0.5, 0.7), frame=frame) for frame in range(3))
    results = ResultsFile(output_path(path))
    results.append(first, "A")
    results.append(second, "A")
    path.write_bytes(path.read_bytes()[:-20])
    resumed = ResultsFile(output_path(path))
    assert resumed.unreadable == 1
    assert resumed.find(first.run, "A") == first and resumed.find(second.run, "A") is None
    resumed.append(third, "A")
    last = ResultsFile(output_path(path))
    assert last.find(first.run, "A") == first and last.find(third.run, "A") == third
    assert last.unreadable == 1


def _read_back(measurement: Measurement) -> Measurement:
    return Measurement.from_json(json.loads(json.dumps(measurement.to_json())))


def test_a_measurement_survives_its_json_line_also_without_iterates() -> None:
    measurement = make_measurement((0.5, 0.7), error_deg=2.0)
    assert _read_back(measurement) == measurement
    score = Score(None, 0.9, 0.8, None, None, None, 0.1)
    alone = _read_back(Measurement(Run("real", "smoke", 3, "unet"), score, "not iterative", "a machine"))
    assert alone.final == score
    assert alone.start is None and alone.best_of(30) is None and not alone.made_worse and alone.iterations == 0


def test_the_depth_of_the_tips_is_compared_along_the_cameras_axis(shipped_psm: Robot) -> None:
    tiny = tiny_scene(shipped_psm, 1, ("left",), 96, 72)
    truth = {"PSM1": tiny.truth[0]}
    longer = {"PSM1": tiny.truth[0] + 0.002 * (np.array(shipped_psm.joint_types) == "prismatic")}
    assert tip_depth_error_mm(tiny.scene, truth, truth) == 0.0
    assert tip_depth_error_mm(tiny.scene, truth, {}) is None
    viewing_direction = tiny.scene.cameras[0].T_camera_world[2, :3]
    change = shipped_psm.forward_kinematics(torch.tensor(longer["PSM1"])) - shipped_psm.forward_kinematics(
        torch.tensor(tiny.truth[0])
    )
    moved = change[shipped_psm.meshes[-1].link][:3, 3].numpy()
    assert tip_depth_error_mm(tiny.scene, longer, truth) == pytest.approx(
        1e3 * abs(moved @ viewing_direction), abs=1e-6
    )


def test_sequence_mode_starts_with_one_error_for_all_frames(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence(frames=4))
    errors = {}
    for method in ("ours", "sequence"):
        for index in range(4):
            frame, run = sequence.frame(index), Run("synthetic", "regular", index, method, 2.0)
            start, truth = start_of(sequence.scene, frame, run, sequence.measured_joints), frame.truth or {}
            errors[method, index] = np.round(start["PSM1"] - truth["PSM1"], 9).tolist()
    assert all(errors["sequence", index] == errors["sequence", 0] for index in range(4))
    assert any(errors["ours", index] != errors["ours", 0] for index in range(4))


def test_hand_eye_runs_are_kept(tmp_path: Path, extractor: FeatureExtractor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hand_eye, "CONDITIONS", CONDITIONS[:1])
    run = HandEyeRun(CONDITIONS[0].name, 0, 0.1, 1e-3, "good")
    monkeypatch.setattr(hand_eye, "_run", lambda condition, seed, extractor: run)
    file, said = output_path(tmp_path, "hand_eye.json"), list[str]()
    assert measure_hand_eye(file, extractor, 1, said.append) == [run]
    assert len(said) == 1 and known_hand_eye(file, extractor) == [run]
    assert measure_hand_eye(file, extractor, 1, said.append) == [run] and len(said) == 1
    file.path.write_text(file.path.read_text().replace(extractor.fingerprint, "other weights"))
    assert known_hand_eye(file, extractor) == []
