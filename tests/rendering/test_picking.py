"""The point of an arm under a pixel."""

import numpy as np
import pytest

from carts_core.model.keypoints import project_keypoints
from carts_core.model.scene import Scene, SceneState
from carts_core.rendering import Renderer, pick_point


def test_a_picked_point_projects_onto_its_pixel(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    renderer = Renderer(scene)
    links = renderer.segment_links(state)[0]
    rows, columns = np.nonzero(links >= 0)
    for index in np.linspace(0, len(rows) - 1, 25).astype(int):
        pixel = float(columns[index]) + 0.5, float(rows[index]) + 0.5
        point = pick_point(scene, renderer, state, pixel)
        assert point is not None
        assert point.link == links[rows[index], columns[index]]
        assert point.name == scene.arms[0].robot.link_names[point.link]
        assert project_keypoints(scene, state, [point], "left")[0].tolist() == pytest.approx(pixel, abs=1e-2)


def test_beside_the_arm_the_nearest_point_in_the_radius_is_picked(scene_and_state: tuple[Scene, SceneState]) -> None:
    scene, state = scene_and_state
    renderer = Renderer(scene)
    rows, columns = np.nonzero(renderer.segment_links(state)[0] >= 0)
    centres = np.column_stack([columns, rows]) + 0.5
    place = centres[columns.argmin()] + (-7.0, 0.0)
    distance = float(np.linalg.norm(centres - place, axis=-1).min())
    beside = float(place[0]), float(place[1])
    assert 0.5 < distance <= 7.0
    assert pick_point(scene, renderer, state, beside) is None
    assert pick_point(scene, renderer, state, beside, radius=distance - 0.1) is None
    assert pick_point(scene, renderer, state, beside, radius=distance + 0.1) is not None
