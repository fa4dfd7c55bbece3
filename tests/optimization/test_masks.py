"""Given masks in the place of a network."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from perfect_predictor import PerfectPredictor

from carts_core.errors import SettingsError
from carts_core.evaluation import dice
from carts_core.imaging.working_image import Window
from carts_core.model.parts import COVERAGE
from carts_core.model.perturbation import perturb
from carts_core.networks import FeatureExtractor
from carts_core.optimization import (
    CalibrationOptimizer,
    FrameOptimizer,
    MaskPredictor,
    NetworkPredictor,
    SequenceOptimizer,
)
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence
from carts_core.settings import FreeParameters

SIZE = {"width": 320, "height": 240}


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=3, **SIZE))


def dice_of(sequence: Sequence, frame: Frame, predictor: MaskPredictor, *, degrees: float = 3.0, **options) -> float:
    """Dice with the frame's own mask, after a run from wrong joint positions."""
    scene = sequence.scene
    start = perturb(scene, frame.truth or {}, degrees, (0, frame.index))
    optimizer = FrameOptimizer(scene, frame, options.pop("backgrounds", {}), predictor, start=start, **options)
    list(optimizer)
    assert optimizer.best is not None
    return dice(Renderer(scene).segment(optimizer.best.state)[0] >= 0, (frame.masks or {})["left"])


def test_a_mask_that_the_start_does_not_touch_is_found(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    truth = (frame.truth or {})["PSM1"]
    moved = {"PSM1": truth + np.deg2rad([9.0, 7.0, *np.zeros(len(truth) - 2)])}
    scene, mask = sequence.scene, (frame.masks or {})["left"]
    renderer = Renderer(scene)
    assert dice(renderer.segment(scene.state(moved))[0] >= 0, mask) < 0.3
    optimizer = FrameOptimizer(scene, frame, {}, MaskPredictor(), start=moved, live=False)
    list(optimizer)
    assert optimizer.best is not None and dice(renderer.segment(optimizer.best.state)[0] >= 0, mask) > 0.97


def test_a_mask_with_holes_and_soft_edges_is_fitted(sequence: Sequence) -> None:
    frame, rng = sequence.frame(0), np.random.default_rng(0)
    mask = cv2.GaussianBlur((frame.masks or {})["left"].astype(np.float32), (0, 0), 1.5)
    mask *= np.kron(rng.random((12, 16)) >= 0.2, np.ones((20, 20))).astype(np.float32)
    assert dice_of(sequence, frame, MaskPredictor(masks=lambda _: {"left": mask}), live=False) > 0.97


def test_pixels_that_are_ignored_do_not_count(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    wrong = (frame.masks or {})["left"].copy()
    ignore = np.zeros_like(wrong)
    ignore[:, 200:] = True
    wrong[:, 200:] = ~wrong[:, 200:]
    whole, found = (frame.masks or {})["left"], []
    for other in (wrong, whole):
        predictor = MaskPredictor(masks=lambda _, other=other: {"left": other})
        found.append(dice_of(sequence, frame, predictor, ignore={"left": ignore}, live=False))
    # The blur reaches over the border of what is ignored by a few pixels.
    assert found[0] == pytest.approx(found[1], abs=0.01)


def test_with_a_network_the_mask_says_where_and_the_network_which_part(sequence: Sequence) -> None:
    frame = sequence.frame(0)
    network = PerfectPredictor(sequence, sequence.scene.state(frame.truth or {}))
    mask = np.zeros((240, 320), bool)
    mask[60:200, 100:240] = True
    predictor = MaskPredictor(network, lambda _: {"left": mask}).for_frame(frame, ["left"])
    images, given = torch.zeros(1, 3, 240, 320), torch.zeros(1, 6, 240, 320)
    whole = Window(0, 0, 320, 240)
    maps, alone = predictor.predict(images, given, whole), network.predict(images, given, whole)
    inside = torch.from_numpy(mask)
    assert torch.allclose(maps[0, COVERAGE].sum(0), inside.float(), atol=1e-5)
    covered = inside & (alone[0, COVERAGE].sum(0) > 0.999)
    assert torch.allclose(maps[0, 1:, covered], alone[0, 1:, covered], atol=2e-3) and covered.any()
    without = MaskPredictor(network, lambda _: {}).for_frame(frame, ["left"])
    assert without is network


def test_a_missing_image_needs_no_mask(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, cameras=("left", "right"), **SIZE))
    frame = sequence.frame(0)
    black = {**frame.images, "right": np.zeros_like(frame.images["right"])}
    masks = {"left": (frame.masks or {})["left"]}
    lacking = replace(frame, images=black, masks=masks, missing=("right",))
    network = PerfectPredictor(sequence, sequence.scene.state(frame.truth or {}))
    assert MaskPredictor(network).for_frame(lacking, ["left", "right"]) is not network
    optimizer = FrameOptimizer(sequence.scene, lacking, {}, MaskPredictor())
    list(optimizer)
    assert optimizer.best is not None
    found = Renderer(sequence.scene, cameras=["left"]).segment(optimizer.best.state.with_camera(0))[0] >= 0
    assert dice(found, masks["left"]) > 0.97


def test_frames_without_a_usable_mask_are_named(sequence: Sequence) -> None:
    frame = replace(sequence.frame(1), masks=None)
    with pytest.raises(SettingsError, match=r"frame 002 has no mask for camera 'left' to fit\. Give a mask"):
        FrameOptimizer(sequence.scene, frame, {}, MaskPredictor())
    small = MaskPredictor(masks=lambda _: {"left": np.zeros((24, 32), bool)})
    with pytest.raises(SettingsError, match=r"has shape \(24, 32\), but its image has \(240, 320\)"):
        FrameOptimizer(sequence.scene, frame, {}, small)


def test_every_frame_of_a_sequence_is_fitted_to_its_own_mask(sequence: Sequence) -> None:
    scene, renderer = sequence.scene, Renderer(sequence.scene)
    optimizer = SequenceOptimizer(scene, sequence.frame, dict.fromkeys(range(3)), MaskPredictor())
    list(optimizer)
    for index, estimate in optimizer.estimates.items():
        mask = (sequence.frame(index).masks or {})["left"]
        assert dice(renderer.segment(estimate.state)[0] >= 0, mask) > 0.98


def test_colours_do_not_replace_given_masks() -> None:
    shipped = Sequence.open(sample_sequence())
    masked = (3, 4)
    network = NetworkPredictor(FeatureExtractor.load())

    def masks(index: int) -> dict[str, np.ndarray]:
        return dict(shipped.frame(index).masks or {}) if index in masked else {}

    predictor = MaskPredictor(network, masks)
    optimizer = SequenceOptimizer(shipped.scene, shipped.frame, dict.fromkeys(range(6)), predictor)
    list(optimizer)
    by_colours = [index for index, visit in optimizer._visits.items() if visit.measurement.by_colours]
    assert by_colours and not set(by_colours) & set(masked)


def test_the_order_in_which_cameras_are_named_changes_no_estimate(tiny_sequence: Callable[..., Path]) -> None:
    sequence = Sequence.open(tiny_sequence(frames=1, cameras=("left", "right"), width=160, height=120))
    frame, found = sequence.frame(0), []
    for cameras in (["left", "right"], ["right", "left"]):
        optimizer = FrameOptimizer(sequence.scene, frame, {}, MaskPredictor(), cameras=cameras, live=False)
        list(optimizer)
        assert optimizer.best is not None
        found.append(optimizer.best)
    np.testing.assert_allclose(found[0].joint_positions()["PSM1"], found[1].joint_positions()["PSM1"], atol=1e-4)
    np.testing.assert_allclose(found[0].joint_std()["PSM1"], found[1].joint_std()["PSM1"], rtol=1e-2)
    assert found[0].loss == pytest.approx(found[1].loss, rel=1e-3)


def test_a_calibration_is_found_from_masks(sequence: Sequence) -> None:
    frames = [sequence.frame(index) for index in range(3)]
    frames = [replace(frame, measured=frame.truth or {}) for frame in frames]
    (arm,) = sequence.scene.arms
    moved = arm.T_world_base.copy()
    moved[:3, 3] += [0.004, -0.003, 0.0]
    wrong = replace(sequence.scene, arms=(replace(arm, T_world_base=moved),))
    free = FreeParameters(joints=False, base_frames=True)
    optimizer = CalibrationOptimizer(wrong, frames, MaskPredictor(), free=free)
    list(optimizer)
    found, renderer = optimizer.result().scene, Renderer(sequence.scene)
    for frame in frames:
        state = found.state(frame.measured)
        assert dice(renderer.segment(state)[0] >= 0, (frame.masks or {})["left"]) > 0.98
