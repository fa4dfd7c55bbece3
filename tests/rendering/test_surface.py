"""Surface maps and their Jacobian against finite differences of a supersampled rendering."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional

from carts_core.camera import Camera
from carts_core.data import Sequence
from carts_core.optimization import FreeParameters
from carts_core.optimization.inputs import smoothed
from carts_core.optimization.parameters import STEP, ParameterVector
from carts_core.parts import PARTS, link_parts
from carts_core.rendering import Renderer, jacobian
from carts_core.robot import Robot
from carts_core.scene import Arm, Scene
from carts_core.surface import COVERAGE, NORMALS, SURFACE_CHANNELS

JOINTS = [0.1, -0.1, 0.13, 0.3, 0.6, -0.5, 0.7]
WIDTH, HEIGHT = 96, 72
BLUR = 1.5


@pytest.fixture(scope="module")
def scene(shipped_psm: Robot) -> Scene:
    """The tip of one arm, close up and from its side."""
    T_base_tip = shipped_psm.forward_kinematics(torch.tensor(JOINTS).double())[-1].numpy()
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    T_camera_world[:3, 3] = -T_camera_world[:3, :3] @ T_base_tip[:3, 3] + [0, 0, 0.045]
    K = (1.1 * WIDTH, 1.1 * WIDTH, WIDTH / 2, HEIGHT / 2)
    return Scene((Arm("PSM1", shipped_psm, np.eye(4)),), (Camera("left", WIDTH, HEIGHT, K, T_camera_world),))


def test_parts_are_told_by_what_moves_them(shipped_psm: Robot) -> None:
    named = {name: PARTS[part] for name, part in zip(shipped_psm.link_names, link_parts(shipped_psm), strict=True)}
    assert named["roll_link"] == "shaft" and named["wrist_pitch_link"] == "wrist" and named["jaw_1_link"] == "jaws"


def test_maps_agree_with_the_rendering(scene: Scene) -> None:
    renderer, state = Renderer(scene), scene.state({"PSM1": JOINTS})
    surface, rendering = renderer.surface(state), renderer(state)
    assert torch.equal(surface.maps[:, COVERAGE].sum(1), rendering.silhouette)
    torch.testing.assert_close(surface.image, rendering.image)
    covered = surface.maps[:, COVERAGE].sum(1) > 0
    assert all((surface.maps[:, part] > 0).any() for part in range(len(PARTS)))
    lengths = surface.maps[:, NORMALS].norm(dim=1)
    torch.testing.assert_close(lengths[covered], torch.ones(int(covered.sum())))
    # Normals are turned towards the camera.
    assert surface.maps[:, NORMALS.stop - 1][covered].mean() < 0


def test_a_window_is_a_part_of_the_whole(scene: Scene) -> None:
    state = scene.state({"PSM1": JOINTS})
    whole = Renderer(scene).surface(state).maps
    part = Renderer(scene, window=(16, 8, 48, 40)).surface(state).maps
    assert torch.equal(part, whole[:, :, 8:48, 16:64])


def test_many_states_at_once_look_as_each_alone(scene: Scene) -> None:
    offsets = torch.linspace(-0.2, 0.2, 3)[:, None] * torch.ones(7)
    parameters = ParameterVector(scene, scene.state({"PSM1": JOINTS}), FreeParameters(), 0.15)
    renderer = Renderer(scene)
    together = renderer.surface_maps(parameters.state(offsets))
    assert together.shape == (3, 1, SURFACE_CHANNELS, HEIGHT, WIDTH)
    for maps, each in zip(together, offsets, strict=True):
        torch.testing.assert_close(maps, renderer.surface(parameters.state(each)).maps)
    assert not torch.equal(together[0], together[1])


@pytest.mark.parametrize("free", ["joints", "base_frames", "extrinsics", "intrinsics"])
def test_the_compiled_jacobian_agrees_with_torch(
    sample_sequence_path: Path, free: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = Sequence.open(sample_sequence_path)
    measured = sequence.scene.state(sequence.frame(0).measured)
    chosen = replace(FreeParameters(joints=False), **{free: True})
    parameters = ParameterVector(sequence.scene, measured, chosen, 0.15)
    renderer, around = Renderer(sequence.scene, width=160, height=120), parameters.around(torch.zeros(len(parameters)))
    compiled = renderer.surface(around, 2 * STEP, margin=4).jacobian

    def without_kernel(*arguments) -> torch.Tensor:
        return jacobian.plain_jacobian(*arguments[:-2], box=arguments[-1])

    monkeypatch.setattr(jacobian, "compiled_jacobian", without_kernel)
    plain = renderer.surface(around, 2 * STEP, margin=4).jacobian
    assert sum(len(block.unknowns) for block in compiled) == len(parameters)
    for one, other in zip(compiled, plain, strict=True):
        assert one.unknowns.equal(other.unknowns) and (one.left, one.top) == (other.left, other.top)
        assert other.values.abs().max() > 1.0
        torch.testing.assert_close(one.values, other.values, atol=1e-2, rtol=1e-4)


@pytest.mark.parametrize("free", ["joints", "base_frames", "extrinsics", "intrinsics"])
def test_the_jacobian_agrees_with_finite_differences(scene: Scene, free: str) -> None:
    parameters = ParameterVector(
        scene, scene.state({"PSM1": JOINTS}), replace(FreeParameters(joints=False), **{free: True}), 0.15
    )
    renderer, fine = Renderer(scene), Renderer(scene, width=8 * WIDTH, height=8 * HEIGHT)
    count, at = len(parameters), torch.zeros(len(parameters))
    eye = torch.eye(count)
    rendering = renderer.surface(parameters.around(at), 2 * STEP)
    analytic_maps = torch.stack([block.dense(count, rendering.maps) for block in rendering.jacobian]).sum(0)
    step = 0.002
    for index in range(count):
        ahead, behind = (
            functional.avg_pool2d(fine.surface(parameters.state(sign * step * eye[index])).maps, 8)
            for sign in (1.0, -1.0)
        )
        numeric = smoothed((ahead - behind) / (2 * step), BLUR)
        analytic = smoothed(analytic_maps[index], BLUR)
        cosine = functional.cosine_similarity(analytic.flatten(), numeric.flatten(), dim=0)
        # One sample per pixel, as the optimizer renders, leaves some aliasing in.
        assert cosine > 0.75, parameters.names[index]
        assert float(analytic.norm() / numeric.norm()) == pytest.approx(1.0, abs=0.25), parameters.names[index]
