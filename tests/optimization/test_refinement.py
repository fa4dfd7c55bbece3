"""Refined masks, with a predictor of the true surface maps."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from perfect_predictor import PerfectPredictor

from carts_core.evaluation import dice
from carts_core.model.scene import SceneState
from carts_core.optimization import MaskRefiner
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=1, cameras=("left", "right"), width=640, height=480))


@pytest.fixture(scope="module")
def frame(sequence: Sequence) -> Frame:
    return sequence.frame(0)


@pytest.fixture(scope="module")
def pose(sequence: Sequence, frame: Frame) -> SceneState:
    return sequence.scene.state(frame.truth or {})


@pytest.fixture(scope="module")
def true_masks(sequence: Sequence, pose: SceneState) -> dict[str, np.ndarray]:
    masks = Renderer(sequence.scene).segment(pose) >= 0
    return {camera.name: mask for camera, mask in zip(sequence.scene.cameras, masks, strict=True)}


@pytest.fixture(scope="module")
def refiner(sequence: Sequence, pose: SceneState) -> MaskRefiner:
    return MaskRefiner(PerfectPredictor(sequence, pose))


def _widened(mask: np.ndarray, pixels: int) -> np.ndarray:
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return cv2.dilate(mask.astype(np.uint8), ellipse).astype(bool)


def test_a_model_that_is_too_thick_is_corrected(
    sequence: Sequence, frame: Frame, pose: SceneState, true_masks: dict[str, np.ndarray], refiner: MaskRefiner
) -> None:
    true = true_masks["left"]
    thick = _widened(true, 3)
    refined = refiner.refine(sequence.scene, frame, pose, {"left": thick})
    assert list(refined) == ["left"]
    assert 1 - dice(refined["left"], true) < 0.5 * (1 - dice(thick, true))


def test_pixels_far_from_the_rendering_and_ignored_ones_stay_as_rendered(
    sequence: Sequence, frame: Frame, pose: SceneState, true_masks: dict[str, np.ndarray], refiner: MaskRefiner
) -> None:
    true = true_masks["left"]
    columns = np.arange(640) < np.flatnonzero(true.any(0)).mean()
    half = true & columns
    refined = refiner.refine(sequence.scene, frame, pose, {"left": half})["left"]
    # The predictor sees the other half; ten pixels are 5 px of the working image.
    np.testing.assert_array_equal(refined & ~_widened(half, 10), False)
    thick, everywhere = _widened(true, 3), np.ones_like(true)
    refined = refiner.refine(sequence.scene, frame, pose, {"left": thick}, {"left": everywhere})
    np.testing.assert_array_equal(refined["left"], thick)
    empty = np.zeros_like(true)
    np.testing.assert_array_equal(refiner.refine(sequence.scene, frame, pose, {"left": empty})["left"], empty)
