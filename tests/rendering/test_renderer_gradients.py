"""Gradients of image and silhouette against finite differences of a supersampled, hence antialiased, rendering."""

from dataclasses import replace

import numpy as np
import pytest
import roma
import torch
from tiny import tiny_scene

from carts_core.model.robot import Robot
from carts_core.model.scene import Scene, SceneState
from carts_core.rendering import Renderer

WIDTH, HEIGHT, SUPERSAMPLING = 640, 480, 3
FUNCTIONALS = 6

NAMES = (
    *("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw", "jaw"),
    *("base_rx", "base_ry", "base_rz", "base_x", "base_y", "base_z"),
    *("camera_rx", "camera_ry", "camera_rz", "camera_x", "camera_y", "camera_z"),
    *("fx", "fy", "cx", "cy"),
)
STEPS = (
    *(1e-3, 1e-3, 2e-4, 2e-2, 1e-2, 1e-2, 2e-2),
    *(1e-3, 1e-3, 1e-3, 2e-4, 2e-4, 2e-4),
    *(1e-3, 1e-3, 1e-3, 2e-4, 2e-4, 2e-4),
    *(4.0, 4.0, 0.5, 0.5),
)
KINDS = {
    "joints [rad]": [0, 1, 3, 4, 5, 6],
    "insertion [m]": [2],
    "base rotation": [7, 8, 9],
    "base translation": [10, 11, 12],
    "camera rotation": [13, 14, 15],
    "camera translation": [16, 17, 18],
    "focal length": [19, 20],
    "principal point": [21, 22],
}


def _rigid(step: torch.Tensor) -> torch.Tensor:
    top = torch.cat([roma.rotvec_to_rotmat(step[:3]), step[3:, None]], 1)
    return torch.cat([top, torch.tensor([[0.0, 0.0, 0.0, 1.0]])])


def moved(state: SceneState, step: torch.Tensor) -> SceneState:
    """The state moved by a step in every parameter of `NAMES`."""
    step = step.float()
    return SceneState(
        (state.joint_positions[0] + step[:7],),
        (state.T_world_base[0] @ _rigid(step[7:13]))[None],
        (_rigid(step[13:19]) @ state.T_camera_world[0])[None],
        state.intrinsics + step[19:][None],
        state.T_mount_world,
    )


def smooth_weights(size: tuple[int, int]) -> torch.Tensor:
    """Random smooth functionals of a picture [functionals, 3, height, width]: each sums it under these weights."""
    coarse = torch.randn(FUNCTIONALS, 3, 5, 6, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(coarse, size=size, mode="bicubic")


@pytest.mark.parametrize("what", ["silhouette", "image"])
def test_gradients_agree_with_finite_differences(what: str, scene_and_state: tuple[Scene, SceneState]) -> None:
    """Within 5 % for each kind of parameter, over several functionals of the picture."""
    scene, state = scene_and_state
    fine = Renderer(scene, width=SUPERSAMPLING * WIDTH, height=SUPERSAMPLING * HEIGHT)
    channels = 3 if what == "image" else 1
    weights = smooth_weights((HEIGHT, WIDTH))[:, :channels]
    fine_weights = smooth_weights((fine.height, fine.width))[:, :channels] / SUPERSAMPLING**2

    def totals(renderer: Renderer, step: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        if what == "silhouette" and not torch.is_grad_enabled():
            picture = torch.from_numpy(renderer.segment(moved(state, step)) >= 0).float()
        else:
            rendering = renderer(moved(state, step))
            picture = rendering.image[0] if what == "image" else rendering.silhouette
        return torch.einsum("fchw,chw->f", weights, picture)

    step = torch.zeros(len(NAMES), dtype=torch.float64, requires_grad=True)
    values = totals(Renderer(scene), step, weights)
    gradient = torch.stack([torch.autograd.grad(value, step, retain_graph=True)[0] for value in values]).numpy()
    differences = np.zeros((FUNCTIONALS, len(NAMES)))
    with torch.no_grad():
        for index, size in enumerate(STEPS):
            ahead = torch.zeros(len(NAMES), dtype=torch.float64)
            ahead[index] = size
            change = totals(fine, ahead, fine_weights) - totals(fine, -ahead, fine_weights)
            differences[:, index] = change.numpy() / (2 * size)
    off = {}
    for kind, columns in KINDS.items():
        error = np.linalg.norm(gradient[:, columns] - differences[:, columns])
        off[kind] = float(error / np.linalg.norm(differences[:, columns]))
        print(f"{what:10} {kind:20} gradient off by {100 * off[kind]:.1f} %")
    assert max(off.values()) < 0.05, off


def test_a_batch_of_hypotheses_renders_as_each_alone(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    offsets = torch.tensor([[0.0] * 7, [0.02] * 7, [-0.02] * 7])
    batch = SceneState(
        (state.joint_positions[0] + offsets,),
        state.T_world_base.expand(3, -1, -1, -1),
        state.T_camera_world.expand(3, -1, -1, -1),
        state.intrinsics.expand(3, -1, -1),
        state.T_mount_world.expand(3, -1, -1, -1),
    )
    renderer = Renderer(scene, width=128, height=96)
    together = renderer(batch)
    assert together.image.shape == (3, 1, 3, 96, 128)
    for index in range(3):
        alone = renderer(scene.state({"PSM1": batch.joint_positions[0][index].numpy()}))
        assert torch.allclose(together.image[index], alone.image, atol=1e-5)
        assert np.array_equal(
            renderer.segment(batch)[index],
            renderer.segment(scene.state({"PSM1": batch.joint_positions[0][index].numpy()})),
        )


def test_a_nearer_arm_hides_the_other(shipped_psm: Robot) -> None:

    tiny = tiny_scene(shipped_psm, 1, ("left",), 160, 120)
    arm, camera = tiny.scene.arms[0], tiny.scene.cameras[0]
    towards = np.eye(4)
    towards[:3, 3] = -0.01 * camera.T_camera_world[2, :3]
    scene = replace(tiny.scene, arms=(arm, replace(arm, name="near", T_world_base=towards)))
    q = tiny.truth[0]
    arm_ids = Renderer(scene).segment(scene.state({"PSM1": q, "near": q}))[0]
    alone = Renderer(replace(scene, arms=scene.arms[1:])).segment(
        replace(scene, arms=scene.arms[1:]).state({"near": q})
    )[0]
    assert (arm_ids[alone >= 0] == 1).mean() > 0.99
    assert (arm_ids == 0).sum() < 0.2 * (arm_ids == 1).sum()


@pytest.mark.gpu
def test_the_renderer_gives_the_same_on_a_gpu(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    here, there = Renderer(scene)(state), Renderer(scene, device="cuda")(state.to("cuda"))
    assert (here.arm_ids != there.arm_ids.cpu()).float().mean() < 1e-3
    assert (here.image - there.image.cpu()).abs().mean() < 1e-3
