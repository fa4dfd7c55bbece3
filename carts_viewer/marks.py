"""Keypoints by name, and where a pose has them in the images."""

import math
from collections.abc import Mapping

from carts_core.model.keypoints import Keypoint, keypoints, project_keypoints
from carts_core.model.scene import Scene, SceneState


def labelled_keypoints(scene: Scene) -> dict[str, Keypoint]:
    """All keypoints of a scene by what people read; the arm is named where there are several."""
    points = [point for arm in scene.arms for point in keypoints(arm)]
    several = len(scene.arms) > 1
    return {f"{point.arm} {point.name}" if several else point.name: point for point in points}


def keypoints_in_image(
    scene: Scene, state: SceneState, camera: str, points: Mapping[str, Keypoint]
) -> list[tuple[str, float, float]]:
    """Label, column and row of every keypoint that is in or near a camera's image, as shares of its size."""
    own = scene.camera(camera)
    found = []
    for label, (u, v) in zip(
        points, project_keypoints(scene, state, list(points.values()), camera).tolist(), strict=True
    ):
        x, y = u / own.width, v / own.height
        if math.isfinite(x) and math.isfinite(y) and -0.2 < x < 1.2 and -0.2 < y < 1.2:
            found.append((label, round(x, 5), round(y, 5)))
    return found
