"""What is read off one run."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from handmade import make_measurement
from tiny import tiny_scene

from carts_core.lab.benchmark import Measurement, Run, Score
from carts_core.lab.benchmark.frame import start_of, tip_depth_error_mm
from carts_core.model.robot import Robot
from carts_core.recording import Sequence


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
