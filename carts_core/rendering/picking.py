"""The point of an arm that is seen at a place of an image."""

import numpy as np
import torch

from ..model.keypoints import Keypoint
from ..model.scene import Scene, SceneState
from .geometry import link_transforms
from .renderer import Renderer


@torch.no_grad()
def pick_point(
    scene: Scene, renderer: Renderer, state: SceneState, pixel: tuple[float, float], radius: float = 0.0
) -> Keypoint | None:
    """The point of the rendered surface at a pixel, fixed to its link.

    Args:
        scene: arms and cameras.
        renderer: of one camera of the scene alone, at its full size.
        state: where the scene's arms and cameras are (no batch).
        pixel: column and row, pixel centres at 0.5 [px].
        radius: how far the centre of the nearest pixel with an arm may be [px]; 0 for the pixel that holds the place.

    Returns:
        The point, called after its link; None where no arm is that near.
    """
    (camera,) = renderer.scene.cameras
    faces, inverse_depth = renderer.visibility(state)
    face_ids = faces[0].cpu().numpy()
    rows, columns = np.nonzero(face_ids >= 0)
    if not len(rows):
        return None
    centres = np.column_stack([columns, rows]) + 0.5
    nearest = int(np.linalg.norm(centres - pixel, axis=-1).argmin())
    row, column = int(rows[nearest]), int(columns[nearest])
    inside = (column, row) == (int(np.floor(pixel[0])), int(np.floor(pixel[1])))
    if not inside and np.linalg.norm(centres[nearest] - pixel) > radius:
        return None
    depth = 1.0 / float(inverse_depth[0, row, column])
    view = scene.cameras.index(scene.camera(camera.name))
    fx, fy, cx, cy = state.intrinsics[view].tolist()
    u, v = centres[nearest]
    p_camera = np.array([(u - cx) / fx * depth, (v - cy) / fy * depth, depth, 1.0])
    link = int(renderer.geometry.face_links[face_ids[row, column]])
    T_camera_link = link_transforms(scene, state)[view, link].double().cpu().numpy()
    x, y, z, _ = np.linalg.solve(T_camera_link, p_camera).tolist()
    links = [(arm, number) for arm in scene.arms for number in range(len(arm.robot.link_names))]
    arm, number = links[link]
    return Keypoint(arm.name, arm.robot.link_names[number], number, (x, y, z))
