"""How surface maps change: the compiled kernel against plain torch, and against finite differences."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from slow_references import jacobian_ref
from torch.nn import functional

from carts_core.imaging.working_image import smoothed
from carts_core.model.scene import Scene, SceneState
from carts_core.optimization import FreeParameters
from carts_core.optimization.variables import DIFFERENCE_SPAN, Variables
from carts_core.recording import Sequence
from carts_core.rendering import Renderer, jacobian

_BLUR = 1.5


@pytest.mark.parametrize("free", ["joints", "base_frames", "extrinsics", "intrinsics"])
def test_the_kernel_agrees_with_torch(sample_sequence_path: Path, free: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two arms seen by two cameras, and by a third one that looks elsewhere."""
    sequence = Sequence.open(sample_sequence_path)
    (left,) = sequence.scene.cameras
    beside, away = left.T_camera_world.copy(), left.T_camera_world.copy()
    beside[0, 3] -= 0.005
    away[2, 3] -= 10.0
    right, blind = replace(left, name="right", T_camera_world=beside), replace(left, name="blind", T_camera_world=away)
    scene = replace(sequence.scene, cameras=(left, right, blind))
    chosen = replace(FreeParameters(joints=False), **{free: True})
    parameters = Variables(scene, scene.state(sequence.frame(0).measured), chosen, 0.15)
    renderer, around = Renderer(scene, width=160, height=120), parameters.around(torch.zeros(len(parameters)))
    compiled = renderer.surface(around, DIFFERENCE_SPAN, margin=4).jacobian

    def without_kernel(*arguments) -> torch.Tensor:
        return jacobian_ref(*arguments[:-2], box=arguments[-1])

    monkeypatch.setattr(jacobian, "jacobian_of_box", without_kernel)
    plain = renderer.surface(around, DIFFERENCE_SPAN, margin=4).jacobian
    seen = [index for index, name in enumerate(parameters.names) if "blind" not in name]
    assert sorted(index for block in compiled for index in block.unknowns.tolist()) == seen
    for one, other in zip(compiled, plain, strict=True):
        assert one.unknowns.equal(other.unknowns) and (one.left, one.top) == (other.left, other.top)
        assert other.values.abs().amax((0, 2, 3, 4))[:2].max() > 1.0 and not other.values[:, 2].any()
        torch.testing.assert_close(one.values, other.values, atol=1e-2, rtol=1e-4)


@pytest.mark.parametrize("free", ["joints", "base_frames", "extrinsics", "intrinsics"])
def test_the_jacobian_agrees_with_finite_differences(close_up: tuple[Scene, SceneState], free: str) -> None:
    scene, state = close_up
    parameters = Variables(scene, state, replace(FreeParameters(joints=False), **{free: True}), 0.15)
    renderer = Renderer(scene)
    fine = Renderer(scene, width=8 * renderer.width, height=8 * renderer.height)
    count, at = len(parameters), torch.zeros(len(parameters))
    eye = torch.eye(count)
    rendering = renderer.surface(parameters.around(at), DIFFERENCE_SPAN)
    analytic_maps = torch.stack([block.dense(count, rendering.maps) for block in rendering.jacobian]).sum(0)
    step = 0.002
    for index in range(count):
        ahead, behind = (
            functional.avg_pool2d(fine.surface(parameters.state(sign * step * eye[index])).maps, 8)
            for sign in (1.0, -1.0)
        )
        numeric = smoothed((ahead - behind) / (2 * step), _BLUR)
        analytic = smoothed(analytic_maps[index], _BLUR)
        cosine = functional.cosine_similarity(analytic.flatten(), numeric.flatten(), dim=0)
        # One sample per pixel, as the optimizer renders, leaves some aliasing in.
        assert cosine > 0.75, parameters.names[index]
        assert float(analytic.norm() / numeric.norm()) == pytest.approx(1.0, abs=0.25), parameters.names[index]
