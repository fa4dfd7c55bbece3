"""The steppable optimizer on a small rendered sequence, with the shipped weights."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor

from carts_core.errors import SettingsError
from carts_core.evaluation import dice
from carts_core.networks import FeatureExtractor
from carts_core.optimization import DescentSolver, FrameOptimizer, FreeParameters, Iterate, SurfaceSolver
from carts_core.recording import Frame, Sequence
from carts_core.rendering import Renderer
from carts_core.settings import Loss
from carts_core.settings.optimization import Method

SURFACE = SurfaceSolver(iterations=8)
SHORT = DescentSolver(iterations=6)


@pytest.fixture(scope="module")
def extractor() -> FeatureExtractor:
    return FeatureExtractor.load()


@pytest.fixture(scope="module")
def sequence(shared_sequence: Callable[..., Path]) -> Sequence:
    return Sequence.open(shared_sequence(frames=1, cameras=("left", "right"), width=320, height=240))


def optimizer_of(sequence: Sequence, extractor: FeatureExtractor, **options) -> FrameOptimizer:
    frame = options.pop("frame", None) or sequence.frame(0)
    backgrounds = {camera.name: sequence.background(camera.name) for camera in sequence.scene.cameras}
    return FrameOptimizer(sequence.scene, frame, backgrounds, extractor, **{"settings": SHORT, **options})


@pytest.fixture(scope="module")
def descended(sequence: Sequence, extractor: FeatureExtractor) -> tuple[FrameOptimizer, list[Iterate]]:
    """A descent with the left camera, and its iterates."""
    optimizer = optimizer_of(sequence, extractor, cameras=["left"], settings=DescentSolver(iterations=20))
    return optimizer, list(optimizer)


def test_a_descent_runs_to_its_last_step(sequence: Sequence, descended: tuple[FrameOptimizer, list[Iterate]]) -> None:
    optimizer, iterates = descended
    assert [iterate.index for iterate in iterates] == list(range(21))
    measured = sequence.frame(0).measured["PSM1"]
    # It is a copy that later steps leave alone.
    assert np.allclose(iterates[0].joint_positions()["PSM1"], measured, atol=1e-6)
    assert not np.allclose(iterates[-1].joint_positions()["PSM1"], measured, atol=1e-4)
    assert optimizer.stop_reason == "iterations"
    assert optimizer.step() is None


def test_the_first_step_of_the_papers_settings(sequence: Sequence, extractor: FeatureExtractor) -> None:
    first, second = optimizer_of(sequence, extractor, cameras=["left"], settings=DescentSolver.paper(1))
    step = np.abs(second.joint_positions()["PSM1"] - first.joint_positions()["PSM1"])
    insertion = sequence.scene.arms[0].robot.joint_names.index("insertion")
    assert step[insertion] == pytest.approx(1e-4, rel=1e-2)
    assert np.delete(step, insertion).max() == pytest.approx(1e-3, rel=1e-2)


def test_reset_goes_back_to_the_start(sequence: Sequence, extractor: FeatureExtractor) -> None:
    optimizer = optimizer_of(sequence, extractor, cameras=["left"])
    losses = [iterate.loss for iterate in optimizer]
    optimizer.reset()
    assert optimizer.history == [] and optimizer.best is None and optimizer.stop_reason is None
    assert [iterate.loss for iterate in optimizer] == pytest.approx(losses, abs=1e-4)


def test_cancel_keeps_what_was_reached(sequence: Sequence, extractor: FeatureExtractor) -> None:
    optimizer = optimizer_of(sequence, extractor, cameras=["left"])
    optimizer.step()
    optimizer.cancel()
    assert optimizer.step() is None
    assert optimizer.stop_reason == "cancelled" and optimizer.best is not None and len(optimizer.history) == 1


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_the_default_solver_raises_dice_on_every_device(sequence: Sequence, device: str) -> None:
    optimizer = optimizer_of(sequence, FeatureExtractor.load(device=device), settings=SurfaceSolver())
    first, *_, last = list(optimizer)
    renderer, masks = Renderer(sequence.scene), sequence.frame(0).masks or {}
    for index, camera in enumerate(("left", "right")):
        before, after = (
            dice(renderer.segment(iterate.state.map(Tensor.cpu))[index] >= 0, masks[camera])
            for iterate in (first, last)
        )
        assert after > before


@pytest.mark.gpu
def test_joints_are_the_same_wherever_the_network_runs(sequence: Sequence) -> None:
    here, there = (
        list(optimizer_of(sequence, FeatureExtractor.load(device=device), settings=SurfaceSolver()))[-1]
        for device in ("cpu", "cuda")
    )
    assert np.allclose(here.joint_positions()["PSM1"], there.joint_positions()["PSM1"], atol=1e-3)


def test_an_occluder_that_is_known_is_left_out(sequence: Sequence, extractor: FeatureExtractor) -> None:
    frame = sequence.frame(0, cameras=["left"])
    mask = (frame.masks or {})["left"]
    everything = {"left": np.ones_like(mask)}
    blind = optimizer_of(sequence, extractor, frame=frame, cameras=["left"], ignore=everything, settings=SURFACE)
    iterates = list(blind)
    assert iterates[0].attention.max() == 0.0
    assert np.allclose(iterates[-1].joint_positions()["PSM1"], frame.measured["PSM1"], atol=1e-5)
    with pytest.raises(SettingsError, match=r"ignore mask of camera 'left' has shape \(3, 3\)"):
        optimizer_of(sequence, extractor, cameras=["left"], ignore={"left": np.ones((3, 3), bool)}, settings=SURFACE)


@pytest.mark.parametrize(("loss", "method"), [*((loss, "adam") for loss in Loss), (Loss.ACS, "gradient_descent")])
def test_every_loss_decreases(sequence: Sequence, extractor: FeatureExtractor, loss: Loss, method: Method) -> None:
    settings = DescentSolver(loss=loss, method=method, iterations=4, learning_rate=2e-3)
    optimizer = optimizer_of(sequence, extractor, cameras=["left"], settings=settings)
    first, *_ = list(optimizer)
    assert optimizer.best is not None and optimizer.best.loss < first.loss


def test_only_what_is_free_moves(sequence: Sequence, extractor: FeatureExtractor) -> None:
    free = FreeParameters(joints=False, extrinsics=True)
    *_, last = list(optimizer_of(sequence, extractor, cameras=["left"], free=free))
    start = sequence.scene.with_cameras(["left"]).state(sequence.frame(0).measured)
    assert np.array_equal(last.state.joint_positions[0].numpy(), start.joint_positions[0].numpy())
    assert not np.allclose(last.state.T_camera_world.numpy(), start.T_camera_world.numpy(), atol=1e-5)


def test_a_tolerance_stops_early(sequence: Sequence, extractor: FeatureExtractor) -> None:
    settings = replace(DescentSolver(iterations=200), tolerance=0.9, patience=3)
    optimizer = optimizer_of(sequence, extractor, cameras=["left"], settings=settings)
    assert len(list(optimizer)) == 4
    assert optimizer.stop_reason == "converged"


def test_an_image_of_another_size_is_named(sequence: Sequence, extractor: FeatureExtractor) -> None:
    frame: Frame = replace(sequence.frame(0), images={"left": np.zeros((10, 10, 3), np.uint8)})
    with pytest.raises(SettingsError, match=r"image of camera 'left' has shape \(10, 10, 3\), .*\(240, 320, 3\)"):
        optimizer_of(sequence, extractor, frame=frame, cameras=["left"])


@pytest.mark.slow
def test_losses_of_all_iterates_compare_in_the_end(sequence: Sequence, extractor: FeatureExtractor) -> None:
    optimizer = FrameOptimizer(sequence.scene, sequence.frame(0), {}, extractor, settings=SurfaceSolver())
    iterates = list(optimizer)
    losses = optimizer.comparable_losses()
    assert len(losses) == len(iterates) == len(optimizer.history)
    assert optimizer.history[-1].stage >= 2, "the default solver looks at the image several times"
    # The end was compared with the last observation at once, earlier iterates with others.
    assert losses[-1] == pytest.approx(iterates[-1].loss, rel=1e-4) and losses[0] > 1.5 * losses[-1]
    assert losses[1] != pytest.approx(iterates[1].loss, rel=1e-3)
