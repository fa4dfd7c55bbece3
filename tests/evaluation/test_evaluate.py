"""Evaluation of optimized frames, cameras alone and together."""

from collections.abc import Callable
from pathlib import Path

import pytest

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
