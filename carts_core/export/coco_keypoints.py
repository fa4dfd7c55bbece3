"""COCO keypoints: `images/`, and `annotations/person_keypoints_default.json` with the keypoints of every arm."""

import json
from itertools import pairwise
from typing import Any

import numpy as np

from ..files import OutputPath, write_text
from ..model.keypoints import Keypoint, keypoints, project_keypoints
from .dataset import Category, Dataset, View
from .monitor import Monitor
from .rle import bounding_box, coco_rle

_OUTSIDE, _HIDDEN, _VISIBLE = 0, 1, 2
"""COCO's words for a keypoint: not labelled, labelled but not visible, labelled and visible."""


def write_coco_keypoints(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the keypoints of every arm in COCO's format, with the arm's mask and box; always a category per arm."""
    points = {arm.name: keypoints(arm) for arm in dataset.scene.arms}
    images, annotations = [], []
    for view in dataset.views(monitor):
        images.append(
            {
                "id": view.id,
                "file_name": dataset.write_image(view, folder / "images"),
                "width": view.camera.width,
                "height": view.camera.height,
                "frame": view.frame.frame_id,
                "camera": view.camera.name,
                "source": view.frame.source,
            }
        )
        for category in dataset.arms:
            annotation = _annotation(dataset, view, category, points[category.arm])
            if annotation is not None:
                annotations.append({"id": len(annotations) + 1, **annotation})
    content = {
        "info": {"description": dataset.sequence.name},
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": [_category(category, points[category.arm]) for category in dataset.arms],
    }
    # The name under which CVAT and Datumaro look for keypoints, whoever has them.
    write_text(folder / "annotations" / "person_keypoints_default.json", json.dumps(content, ensure_ascii=False))


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


def _annotation(
    dataset: Dataset, view: View, category: Category, points: tuple[Keypoint, ...]
) -> dict[str, Any] | None:
    """An arm in a view; None where neither a pixel nor a keypoint of it is in the image."""
    arms = dataset.label_image(view, "arms")
    mask = arms == category.id
    pixels = project_keypoints(dataset.scene, dataset.state(view.frame), points, view.camera.name).double().numpy()
    values: list[float] = []
    for u, v in pixels:
        inside = bool(np.isfinite([u, v]).all()) and 0 <= u < view.camera.width and 0 <= v < view.camera.height
        if not inside:
            values += [0.0, 0.0, _OUTSIDE]
            continue
        values += [round(float(u), 3), round(float(v), 3), _VISIBLE if mask[int(v), int(u)] else _HIDDEN]
    labelled = sum(flag > 0 for flag in values[2::3])
    if not labelled and not mask.any():
        return None
    return {
        "image_id": view.id,
        "category_id": category.id,
        "keypoints": values,
        "num_keypoints": labelled,
        "segmentation": coco_rle(mask),
        "area": int(mask.sum()),
        "bbox": list(bounding_box(mask)) if mask.any() else [0, 0, 0, 0],
        "iscrowd": 0,
    }
