"""COCO keypoints: `images/`, and `annotations/person_keypoints_default.json` with the keypoints of every arm."""

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np

from ..files import OutputPath
from ..model.keypoints import Keypoint, keypoints, project_keypoints
from .coco import Annotation, mask_annotation, write_annotations
from .dataset import Category, Dataset, View
from .monitor import Monitor

_OUTSIDE, _HIDDEN, _VISIBLE = 0, 1, 2
"""COCO's words for a keypoint: not labelled, labelled but not visible, labelled and visible."""


def write_coco_keypoints(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the keypoints of every arm in COCO's format, with the arm's mask and box; always a category per arm."""
    points = {arm.name: keypoints(arm) for arm in dataset.scene.arms}

    def annotations(view: View) -> Iterable[Annotation]:
        for category in dataset.arms:
            yield from _annotations(dataset, view, category, points[category.arm])

    categories = [_category(category, points[category.arm]) for category in dataset.arms]
    # "person" whoever has the keypoints: CVAT and Datumaro look for no other name.
    write_annotations(dataset, folder, monitor, "person_keypoints", categories, annotations)


def _category(category: Category, points: tuple[Keypoint, ...]) -> dict[str, Any]:
    names = [point.name for point in points]
    tips = [number for number, name in enumerate(names, start=1) if name.endswith(" tip")]
    joints = [number for number in range(1, len(names) + 1) if number not in tips]
    # The joints lie along the instrument, and every tip hangs on the joint that is nearest to it.
    skeleton = [*pairwise(joints), *((tip, joints[0]) for tip in tips if joints)]
    return {
        "id": category.id,
        "name": category.name,
        "supercategory": category.arm,
        "keypoints": names,
        "skeleton": [list(edge) for edge in skeleton],
    }


def _annotations(
    dataset: Dataset, view: View, category: Category, points: tuple[Keypoint, ...]
) -> Iterable[Annotation]:
    """An arm in a view; none where neither a pixel nor a keypoint of it is in the image."""
    mask = dataset.label_image(view, "arms") == category.id
    pixels = project_keypoints(dataset.scene, dataset.state(view.frame), points, view.camera.name).double().numpy()
    values: list[float] = []
    for u, v in pixels:
        inside = bool(np.isfinite([u, v]).all()) and 0 <= u < view.camera.width and 0 <= v < view.camera.height
        if not inside:
            values += [0.0, 0.0, _OUTSIDE]
            continue
        values += [round(float(u), 3), round(float(v), 3), _VISIBLE if mask[int(v), int(u)] else _HIDDEN]
    labelled = sum(flag > 0 for flag in values[2::3])
    if labelled or mask.any():
        yield {**mask_annotation(view, category.id, mask), "keypoints": values, "num_keypoints": labelled}
