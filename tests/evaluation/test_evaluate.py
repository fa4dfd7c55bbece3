"""Metrics, and evaluation against ground truth."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from moving import Motion, let_camera_move, swing
from tiny import tiny_scene

from carts_core.evaluation import dice, evaluate, joint_mae_deg, normalized_surface_distance
from carts_core.model.perturbation import perturb
from carts_core.model.robot import Robot
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FreeParameters, SequenceSettings, SurfaceSolver
from carts_core.recording import Sequence

DVRK = Path(__file__).parents[1] / "sequences" / "dvrk_stereo.toml"
REAL_DICE = [0.961, 0.977, 0.962, 0.977]


def test_dice_of_equal_disjoint_and_half_overlapping_masks() -> None:
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert dice(a, b) == 1.0
    a[:2], b[2:] = True, True
    assert dice(a, a) == 1.0 and dice(a, b) == 0.0
    b[:] = False
    b[1:3] = True
    assert dice(a, b) == 0.5


def _normalized_surface_distance_ref(a: np.ndarray, b: np.ndarray, tolerance: float) -> float:
    """Every outline pixel against every other one."""

    def outline(mask: np.ndarray) -> list[tuple[int, int]]:
        height, width = mask.shape
        return [
            (row, column)
            for row, column in np.argwhere(mask).tolist()
            if any(
                0 <= row + y < height and 0 <= column + x < width and not mask[row + y, column + x]
                for y, x in ((0, 1), (1, 0), (0, -1), (-1, 0))
            )
        ]

    outlines = outline(a), outline(b)
    if not outlines[0] and not outlines[1]:
        return float(np.array_equal(a, b))
    near = sum(
        any(np.hypot(row - y, column - x) <= tolerance for y, x in other)
        for one, other in (outlines, outlines[::-1])
        for row, column in one
    )
    return near / (len(outlines[0]) + len(outlines[1]))


def test_the_normalized_surface_distance_is_that_of_its_slow_twin() -> None:
    rng = np.random.default_rng(0)
    for tolerance in (0.0, 1.0, 1.5, 3.0):
        for share in (0.02, 0.3, 0.9):
            a, b = rng.random((2, 17, 23)) < share
            expected = _normalized_surface_distance_ref(a, b, tolerance)
            assert normalized_surface_distance(a, b, tolerance) == pytest.approx(expected, abs=1e-12)


def test_the_surface_distance_of_empty_and_full_masks() -> None:
    none, some, all_ = np.zeros((9, 9), bool), np.zeros((9, 9), bool), np.ones((9, 9), bool)
    some[3:6, 3:6] = True
    assert normalized_surface_distance(none, none, 2.0) == normalized_surface_distance(all_, all_, 2.0) == 1.0
    assert normalized_surface_distance(none, some, 2.0) == normalized_surface_distance(none, all_, 2.0) == 0.0


def test_the_joint_error_counts_measured_revolute_joints_in_degrees(shipped_psm: Robot) -> None:
    tiny = tiny_scene(shipped_psm, 1, ("left",), 96, 72)
    truth = {"PSM1": np.zeros(7)}
    estimate = {"PSM1": np.deg2rad([1.0, -3.0, 500.0, 0.0, 0.0, 0.0, 70.0])}
    assert joint_mae_deg(tiny.scene, estimate, truth, {"PSM1": ("yaw", "pitch", "insertion")}) == pytest.approx(2.0)
    assert joint_mae_deg(tiny.scene, estimate, {}, {"PSM1": ("yaw",)}) is None


def test_a_perturbation_moves_every_joint_by_its_size_and_the_seed_fixes_it(shipped_psm: Robot) -> None:
    tiny = tiny_scene(shipped_psm, 1, ("left",), 96, 72)
    start = {"PSM1": tiny.truth[0] + 0.05}
    moved = perturb(tiny.scene, start, 2.0, seed=3)["PSM1"] - start["PSM1"]
    expected = np.where([kind == "prismatic" for kind in shipped_psm.joint_types], 2e-3, np.deg2rad(2.0))
    assert np.allclose(np.abs(moved), expected)
    assert np.array_equal(perturb(tiny.scene, start, 2.0, seed=3)["PSM1"], moved + start["PSM1"])
    assert any(
        not np.array_equal(perturb(tiny.scene, start, 2.0, seed=s)["PSM1"], moved + start["PSM1"]) for s in range(4)
    )


def test_a_perturbation_keeps_to_the_limits_and_the_chosen_joints(shipped_psm: Robot) -> None:
    tiny = tiny_scene(shipped_psm, 1, ("left",), 96, 72)
    start = {"PSM1": shipped_psm.joint_limits[:, 1].copy()}
    moved = perturb(tiny.scene, start, 5.0, seed=0)["PSM1"]
    assert (moved <= start["PSM1"]).all()
    only = perturb(tiny.scene, {"PSM1": tiny.truth[0]}, 5.0, 0, {"PSM1": ("yaw",)})["PSM1"] != tiny.truth[0]
    assert only.tolist() == [True, False, False, False, False, False, False]


@pytest.mark.parametrize(
    ("model", "frames", "together"), [(None, [0], False), (None, [0], True), (SequenceSettings(), [0, 1], False)]
)
def test_every_camera_has_its_scores(
    tiny_sequence: Callable[..., Path], model: SequenceSettings | None, frames: list[int], together: bool
) -> None:
    sequence = Sequence.open(tiny_sequence(frames=2, cameras=("left", "right"), width=320, height=240))
    scores = list(
        evaluate(
            sequence,
            FeatureExtractor.load(),
            frames=frames,
            cameras=["left", "right"],
            domains=["regular"],
            settings=SurfaceSolver(iterations=3),
            free=FreeParameters(),
            model=model,
            together=together,
        )
    )
    found = [(score.camera, score.frame) for score in scores]
    assert sorted(found) == [(camera, f"{index + 1:03d}") for camera in ("left", "right") for index in frames]
    errors = {score.joint_mae_deg_after for score in scores if score.frame == scores[-1].frame}
    assert len(errors) == (1 if together else 2), "cameras that are optimized together agree on the joints"


@pytest.mark.parametrize("model", [None, SequenceSettings()])
def test_scores_use_the_moving_cameras_pose(tiny_sequence: Callable[..., Path], model: SequenceSettings | None) -> None:
    path = let_camera_move(tiny_sequence(frames=2), Motion(swing(4).Ts_world_mount[1:3]))
    (path.parent / "kinematics.csv").write_bytes((path.parent / "truth.csv").read_bytes())
    found = evaluate(
        Sequence.open(path),
        FeatureExtractor.load(),
        frames=[0, 1],
        cameras=["left"],
        domains=["regular"],
        settings=SurfaceSolver(iterations=1),
        free=FreeParameters(),
        model=model,
    )
    # The arm starts at its true joint positions, so that the rendering is the mask.
    assert [score.dice_before for score in found] == pytest.approx([1.0, 1.0], abs=0.02)


@pytest.mark.usefixtures("shared_dir")
def test_real_frames_keep_their_scores() -> None:
    """Two frames of the dVRK recording, from the measured joints and from 2 degrees off, with the shipped networks."""
    sequence, extractor = Sequence.open(DVRK), FeatureExtractor.load()
    options = {"frames": [4, 22], "cameras": ["left"], "domains": ["regular"]}
    settings, free, after = SurfaceSolver(), FreeParameters(), []
    for degrees in (0.0, 2.0):
        found = evaluate(sequence, extractor, **options, settings=settings, free=free, perturb_deg=degrees)
        scores = list(found)
        assert [score.verdict for score in scores] == ["good"] * 2
        after += [score.dice_after for score in scores]
    assert after == pytest.approx(REAL_DICE, abs=0.003)
