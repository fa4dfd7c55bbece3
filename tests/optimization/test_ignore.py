"""Proposed ignore masks: detected occluders, and the repeated solution of a frame."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer, SurfaceSolver, propose_ignore
from carts_core.recording import Sequence
from carts_core.settings.stages import OCCLUDED

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def scene(shared_sequence: Callable[..., Path]) -> Scene:
    return Sequence.open(shared_sequence(frames=1, width=2 * WIDTH, height=2 * HEIGHT)).scene


def _arm() -> tuple[np.ndarray, np.ndarray]:
    silhouette, similarity = np.zeros((1, HEIGHT, WIDTH)), np.ones((1, HEIGHT, WIDTH))
    silhouette[0, 100:140, :200] = 1.0
    return silhouette, similarity


def test_a_gap_in_the_arm_and_what_sticks_out_of_it_are_proposed_at_the_cameras_size(scene: Scene) -> None:
    silhouette, similarity = _arm()
    similarity[0, 105:135, 40:70] = 0.0
    similarity[0, 70:100, 120:150] = 0.0
    mask = propose_ignore(scene, silhouette, similarity)["left"]
    assert mask.shape == (2 * HEIGHT, 2 * WIDTH) and mask.dtype == bool
    assert mask[240, 110] and mask[170, 270]
    assert not mask[240, 20] and mask.mean() < 0.05


@pytest.mark.parametrize(
    ("rows", "columns"),
    [(slice(97, 101), slice(200)), (slice(180, 220), slice(250, 300)), (slice(95, 145), slice(150))],
    ids=["a thin rim", "apart from the arm", "most of the arm"],
)
def test_wrong_estimates_and_other_objects_are_not_proposed(scene: Scene, rows: slice, columns: slice) -> None:
    silhouette, similarity = _arm()
    similarity[0, rows, columns] = 0.0
    assert propose_ignore(scene, silhouette, similarity) == {}


@pytest.mark.slow
def test_proposed_occluders_are_ignored(sample_sequence_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sequence, extractor = Sequence.open(sample_sequence_path), FeatureExtractor.load()
    frame = sequence.frame(0, cameras=["left"])
    height, width = frame.images["left"].shape[:2]
    left_half = np.arange(width) < width // 2
    proposal = {"left": np.broadcast_to(left_half, (height, width))}
    settings = SurfaceSolver(stages=OCCLUDED)
    given = {"left": np.zeros((height, width), bool)}

    def optimizer(chosen: SurfaceSolver, ignore: dict[str, np.ndarray]) -> FrameOptimizer:
        return FrameOptimizer(sequence.scene, frame, {}, extractor, ignore=ignore, settings=chosen, cameras=["left"])

    monkeypatch.setattr("carts_core.optimization.frame_problem.propose_ignore", lambda *_: proposal)
    proposing = optimizer(settings, given)
    steps = len(list(proposing))
    assert proposing.best is not None and np.array_equal(proposing.proposed["left"], proposal["left"])
    given_at_once = optimizer(SurfaceSolver(), proposal)
    list(given_at_once)
    assert given_at_once.best is not None and len(given_at_once.history) < steps
    assert proposing.best.loss == given_at_once.best.loss
    proposing.reset()
    assert proposing.proposed == {} and len(list(proposing)) == steps


def test_without_a_proposal_a_frame_is_solved_once(sample_sequence_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("carts_core.optimization.frame_problem.propose_ignore", lambda *_: {})
    sequence, extractor = Sequence.open(sample_sequence_path), FeatureExtractor.load()
    frame = sequence.frame(0, cameras=["left"])
    runs = [
        list(FrameOptimizer(sequence.scene, frame, {}, extractor, settings=settings, cameras=["left"]))
        for settings in (SurfaceSolver(), SurfaceSolver(stages=OCCLUDED))
    ]
    assert [iterate.loss for iterate in runs[0]] == [iterate.loss for iterate in runs[1]]
