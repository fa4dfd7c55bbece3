"""Hints that commands print after their results."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from carts_core import recording
from carts_core.cli.printing import base_frame_hint, constant_correction_hint, kept_start_hint
from carts_core.export import KinematicsRow


def test_wrong_base_frames_are_named_with_the_ways_out_of_it() -> None:
    hint = base_frame_hint("right", [0.5, None, 0.3])
    assert hint is not None
    for part in ("right:", "40 %", "carts calibrate", "--base-frames"):
        assert part in hint


def test_frames_that_say_nothing_or_little_give_no_hint() -> None:
    assert base_frame_hint("left", []) is None
    assert base_frame_hint("left", [None, None]) is None
    assert base_frame_hint("left", [0.4, 0.01, 0.02, 0.0]) is None, "one frame is not the recording"


def test_kept_starts_are_counted() -> None:
    assert kept_start_hint("left", ["converged", "warm"]) is None
    hint = kept_start_hint("left", ["start kept", "converged", "start kept"])
    assert hint is not None and hint.startswith("left: 2 of 3 runs kept the initial values")


JOINTS = ("yaw", "pitch", "insertion")


def hint_of(path: Path, offsets: Sequence[tuple[float, float, float]], source: str = "optimized") -> str | None:
    """The hint for corrections of the first frames' first three joints [rad, rad, m]."""
    sequence = recording.Sequence.open(path)
    (arm,) = sequence.scene.arms
    assert arm.robot.joint_names[:3] == JOINTS
    rows = []
    for index, offset in enumerate(offsets):
        values = sequence.measured[arm.name][index].copy()
        values[:3] += offset
        rows.append(KinematicsRow(sequence.frame_ids[index], source, {arm.name: values}))
    return constant_correction_hint("left", sequence, rows)


def test_large_corrections_that_are_the_same_in_all_frames_are_said_with_their_units(
    tiny_sequence: Callable[..., Path],
) -> None:
    path = tiny_sequence(frames=5)
    noise = np.random.default_rng(0).normal(0.0, 1e-3, (5, 3))
    constant = [tuple(row) for row in np.array([0.02, np.radians(-6.0), 0.012]) + noise]
    hint = hint_of(path, constant)
    assert hint is not None and hint.startswith("left: corrections are large")
    assert "PSM1.pitch -6." in hint and "PSM1.insertion +1" in hint and " mm" in hint and "yaw" not in hint
    assert hint_of(path, constant[:3]) is None
    assert hint_of(path, constant, "measured") is None


def test_small_and_changing_corrections_are_not(tiny_sequence: Callable[..., Path]) -> None:
    path = tiny_sequence(frames=5)
    assert hint_of(path, [(0.05, -0.05, 0.003)] * 5) is None
    assert hint_of(path, [(sign * 0.2, 0.0, sign * 0.02) for sign in (1, -1, 1, -1, 1)]) is None
