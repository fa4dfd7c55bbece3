"""Outlines against those of a much finer rendering, and their motion against where they are a little later."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from slow_references import normal_motion_ref, outline_pixels_ref, outline_position_ref

from carts_core.model.scene import Scene, SceneState
from carts_core.optimization import FreeParameters
from carts_core.optimization.variables import DIFFERENCE_SPAN, Variables
from carts_core.rendering import Outline, Renderer
from carts_core.rendering.jacobian import outline_position

WIDTH, HEIGHT, FINER = 640, 480, 4


def outline(renderer: Renderer, parameters: Variables, offsets: torch.Tensor) -> Outline:
    tangents = renderer.tangents(parameters.around(offsets), DIFFERENCE_SPAN)
    return renderer.outline(parameters.state(offsets), tangents)


def rims(renderer: Renderer, state: SceneState) -> np.ndarray:
    """Where silhouettes end in a finer rendering, [n, 2] pixels of the coarse one, the first one's centre at 0."""
    seen = renderer.segment(state)[0] >= 0
    right = np.argwhere(seen[:, 1:] != seen[:, :-1]) + np.array([0.5, 1.0])
    down = np.argwhere(seen[1:] != seen[:-1]) + np.array([1.0, 0.5])
    return np.concatenate([right, down])[:, ::-1] / FINER - 0.5


def test_outlines_are_where_a_finer_rendering_has_them(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    parameters = Variables(scene, state, FreeParameters(), 0.15)
    found = outline(Renderer(scene), parameters, torch.zeros(len(parameters)))
    true = rims(Renderer(scene, width=FINER * WIDTH, height=FINER * HEIGHT), state)
    distance, nearest = KDTree(true).query(found.position.numpy().T)
    against_background = distance < 3.0  # the others are where one part hides another
    assert against_background.mean() > 0.6
    # Along a row or a column of pixels nobody can tell to less than half a pixel.
    assert np.quantile(distance[against_background], 0.9) < 0.6
    along = ((true[nearest] - found.position.numpy().T) * found.normal.numpy().T).sum(1)[against_background]
    assert abs(along.mean()) < 0.05
    assert torch.linalg.vector_norm(found.normal, dim=0).sub(1.0).abs().max() < 1e-4
    # Two pixels outwards there is less of the arm than two pixels inwards.
    mask = Renderer(scene).segment(state)[0] >= 0
    sides = []
    for step in (2.0, -2.0):
        column, row = (found.position + step * found.normal).round().long().numpy()[:, against_background]
        sides.append(mask[row.clip(0, HEIGHT - 1), column.clip(0, WIDTH - 1)].mean())
    assert sides[0] < 0.1 and sides[1] > 0.9


@pytest.mark.parametrize("free", ["joints", "base_frames", "extrinsics", "intrinsics"])
def test_outlines_move_as_they_say(free: str, scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    chosen = replace(FreeParameters(joints=False), **{free: True})
    parameters = Variables(scene, state, chosen, 0.15)
    renderer, fine = Renderer(scene), Renderer(scene, width=FINER * WIDTH, height=FINER * HEIGHT)
    zero = torch.zeros(len(parameters))
    found = outline(renderer, parameters, zero)
    position, normal = found.position.numpy().T, found.normal.numpy().T

    def residual(offsets: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Distance of each outline pixel from the nearest rim, and its component along the normal [px]."""
        ends = rims(fine, parameters.state(offsets))
        distance, nearest = KDTree(ends).query(position)
        return distance, ((ends[nearest] - position) * normal).sum(1)

    distance, before = residual(zero)
    predicted, seen = [], []
    for unknown, name in enumerate(parameters.names):
        offsets = zero.clone()
        offsets[unknown] = min(1.5 / max(float(found.motion[unknown].abs().max()), 1e-3), 0.1)
        later, after = residual(offsets)
        usable = (distance < 0.6) & (later < 2.1)
        assert usable.sum() > 100, name
        predicted.append((found.motion[unknown].numpy() * float(offsets[unknown]))[usable])
        seen.append((after - before)[usable])
    predicted, seen = np.concatenate(predicted), np.concatenate(seen)
    assert np.abs(seen).max() > 1.0
    assert np.median(np.abs(predicted - seen)) < 0.5 / FINER
    assert np.corrcoef(predicted, seen)[0, 1] > 0.97


def test_a_straight_outline_is_between_its_pixels() -> None:
    inverse_depth = torch.zeros(1, 40, 50)
    inverse_depth[:, :, :20] = 10.0
    pixel = outline_pixels_ref(inverse_depth).flatten().nonzero()[:, 0]
    position, normal = outline_position(inverse_depth, pixel)
    assert torch.allclose(position[0], torch.tensor(19.5), atol=0.05)
    assert torch.allclose(position[1], (pixel // 50).float(), atol=1e-4)
    assert torch.allclose(normal, torch.tensor([[1.0], [0.0]]), atol=1e-4)


def test_an_empty_view_has_no_outline(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    away = replace(state, T_world_base=state.T_world_base + torch.tensor([[[0, 0, 0, 9.0]] * 3 + [[0, 0, 0, 0]]]))
    parameters = Variables(scene, away, FreeParameters(), 0.15)
    found = outline(Renderer(scene), parameters, torch.zeros(len(parameters)))
    assert found.position.shape == (2, 0) and found.motion.shape == (len(parameters), 0)


def test_the_kernels_agree_with_torch(
    scene_and_state: tuple[Scene, SceneState], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, state = scene_and_state
    parameters = Variables(scene, state, FreeParameters(extrinsics=True, intrinsics=True), 0.15)
    zero, renderer = torch.zeros(len(parameters)), Renderer(scene)
    compiled = outline(renderer, parameters, zero)
    monkeypatch.setattr(
        "carts_core.rendering.jacobian.keep_outline",
        lambda faces, near, *_: np.where(outline_pixels_ref(torch.from_numpy(near)), faces, -1),
    )
    monkeypatch.setattr("carts_core.rendering.renderer.outline_position", outline_position_ref)
    monkeypatch.setattr("carts_core.rendering.renderer.normal_motion", normal_motion_ref)
    plain = outline(renderer, parameters, zero)
    assert len(plain.camera) > 500
    assert torch.equal(compiled.camera, plain.camera) and torch.equal(compiled.parts, plain.parts)
    for name in ("position", "normal", "motion"):
        found, expected = getattr(compiled, name), getattr(plain, name)
        torch.testing.assert_close(found, expected, atol=1e-3 * float(expected.abs().max()), rtol=1e-3)
