"""Surface maps against renderings, and of many states at once."""

import re
from dataclasses import replace
from pathlib import Path

import torch

from carts_core.model.parts import COVERAGE, NORMALS, PARTS, SURFACE_CHANNELS, link_parts
from carts_core.model.robot import Robot
from carts_core.model.scene import Scene, SceneState
from carts_core.optimization import FreeParameters
from carts_core.optimization.variables import Variables
from carts_core.rendering import Renderer
from carts_core.resources import shipped_robot


def test_an_instrument_whose_jaws_do_not_move_has_a_shaft_and_a_wrist_all_the_same(tmp_path: Path) -> None:
    urdf = shipped_robot().read_text()
    urdf = urdf.replace('filename="', f'filename="{shipped_robot().parent}/')
    for name in ("jaw", "jaw_1", "jaw_2"):
        urdf = urdf.replace(f'<joint name="{name}" type="revolute">', f'<joint name="{name}" type="fixed">')
    urdf = re.sub(r"<mimic [^>]*/>", "", urdf)
    (tmp_path / "hook.urdf").write_text(urdf)
    robot = Robot.load(tmp_path / "hook.urdf")
    assert "jaw" not in robot.joint_names
    named = {name: PARTS[part] for name, part in zip(robot.link_names, link_parts(robot), strict=True)}
    assert named["roll_link"] == "shaft" and named["wrist_pitch_link"] == "wrist" and named["jaw_1_link"] == "jaws"


def test_maps_agree_with_the_rendering(close_up: tuple[Scene, SceneState]) -> None:
    scene, state = close_up
    renderer = Renderer(scene)
    surface, rendering = renderer.surface(state), renderer(state)
    assert torch.equal(surface.maps[:, COVERAGE].sum(1), rendering.silhouette)
    torch.testing.assert_close(surface.image, rendering.image)
    covered = surface.maps[:, COVERAGE].sum(1) > 0
    assert all((surface.maps[:, part] > 0).any() for part in range(len(PARTS)))
    lengths = surface.maps[:, NORMALS].norm(dim=1)
    torch.testing.assert_close(lengths[covered], torch.ones(int(covered.sum())))
    # Normals are turned towards the camera.
    assert surface.maps[:, NORMALS.stop - 1][covered].mean() < 0


def test_a_window_is_a_part_of_the_whole(close_up: tuple[Scene, SceneState]) -> None:
    scene, state = close_up
    whole = Renderer(scene).surface(state).maps
    part = Renderer(scene, window=(16, 8, 48, 40)).surface(state).maps
    assert torch.equal(part, whole[:, :, 8:48, 16:64])


def test_many_states_at_once_look_as_each_alone(close_up: tuple[Scene, SceneState]) -> None:
    scene, state = close_up
    (left,) = scene.cameras
    T_camera_world = left.T_camera_world.copy()
    T_camera_world[0, 3] -= 0.004
    scene = replace(scene, cameras=(left, replace(left, name="right", T_camera_world=T_camera_world)))
    start = scene.state({"PSM1": state.joint_positions[0]})
    parameters, renderer = Variables(scene, start, FreeParameters(), 0.15), Renderer(scene)
    offsets = torch.linspace(-0.03, 0.03, 3)[:, None] * torch.ones(len(parameters))
    together = renderer.surface_maps(parameters.state(offsets))
    assert together.shape == (3, 2, SURFACE_CHANNELS, left.height, left.width)
    for maps, each in zip(together, offsets, strict=True):
        torch.testing.assert_close(maps, renderer.surface(parameters.state(each)).maps)
    assert together[:, :, COVERAGE].sum((2, 3, 4)).flatten().unique().numel() == 6, "each is another picture"
