"""Evaluation of optimized frames, cameras alone and together."""

from collections.abc import Callable
from pathlib import Path

import pytest
from moving import Motion, let_camera_move, swing

from carts_core.evaluation import evaluate, evaluate_sequence
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FreeParameters, SequenceSettings, SurfaceSolver
from carts_core.recording import Sequence


@pytest.mark.parametrize("together", [False, True])
def test_every_camera_of_a_frame_has_a_score(tiny_sequence: Callable[..., Path], together: bool) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, cameras=("left", "right"), width=320, height=240))
    scores = list(
        evaluate(
            sequence,
            FeatureExtractor.load(),
            frames=[0],
            cameras=["left", "right"],
            domains=["regular"],
            settings=SurfaceSolver(iterations=3),
            free=FreeParameters(),
            together=together,
        )
    )
    assert [score.camera for score in scores] == ["left", "right"]
    errors = {score.joint_mae_deg_after for score in scores}
    assert len(errors) == (1 if together else 2), "cameras that look together agree on the joints"


@pytest.mark.parametrize("together", [False, True])
def test_every_camera_of_a_sequence_has_its_scores(tiny_sequence: Callable[..., Path], together: bool) -> None:
    sequence = Sequence.open(tiny_sequence(frames=2, cameras=("left", "right"), width=320, height=240))
    scores = list(
        evaluate_sequence(
            sequence,
            FeatureExtractor.load(),
            frames=[0, 1],
            cameras=["left", "right"],
            domains=["regular"],
            settings=SurfaceSolver(iterations=3),
            model=SequenceSettings(),
            free=FreeParameters(),
            together=together,
        )
    )
    assert {(score.camera, score.frame) for score in scores} == {
        (c, f) for c in ("left", "right") for f in ("001", "002")
    }
    errors = {score.joint_mae_deg_after for score in scores if score.frame == "002"}
    assert len(errors) == (1 if together else 2), "cameras that look together agree on the joints"


@pytest.mark.parametrize("mode", ["frame", "sequence"])
def test_the_start_of_a_moving_camera_is_compared_from_where_the_camera_is(
    tiny_sequence: Callable[..., Path], mode: str
) -> None:
    path = let_camera_move(tiny_sequence(frames=2), Motion(swing(4).Ts_world_mount[1:3]))
    (path.parent / "kinematics.csv").write_bytes((path.parent / "truth.csv").read_bytes())
    sequence = Sequence.open(path)
    options = {"frames": [0, 1], "cameras": ["left"], "domains": ["regular"]}
    settings, free = SurfaceSolver(iterations=1), FreeParameters()
    if mode == "frame":
        found = evaluate(sequence, FeatureExtractor.load(), **options, settings=settings, free=free)
    else:
        model = SequenceSettings()
        found = evaluate_sequence(
            sequence, FeatureExtractor.load(), **options, settings=settings, free=free, model=model
        )
    before = [score.dice_before for score in found]
    # The arm starts at its true joint positions, so that the rendering is the mask.
    assert before == pytest.approx([1.0, 1.0], abs=0.02)
