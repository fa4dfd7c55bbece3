"""COCO keypoints and BOP poses, read back with the tools of others and compared with the scene."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from awkward import CAMERA, all_views
from pycocotools.coco import COCO

from carts_core.export import Dataset, export
from carts_core.model.camera import HALF_PIXEL
from carts_core.model.keypoints import keypoints, project_keypoints


def test_coco_keypoints_lie_where_the_camera_sees_them(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "coco-keypoints", tmp_path / "out")
    coco: Any = COCO(str(folder / "annotations" / "person_keypoints_default.json"))
    views = {view.id: view for view in all_views(dataset)}
    seen: set[int] = set()
    for annotation in coco.loadAnns(coco.getAnnIds()):
        (category,), view = coco.loadCats(annotation["category_id"]), views[annotation["image_id"]]
        points = keypoints(dataset.scene.arm(category["name"]))
        assert category["keypoints"] == [point.name for point in points]
        assert {index for edge in category["skeleton"] for index in edge} == set(range(1, len(points) + 1))
        pixels = project_keypoints(dataset.scene, dataset.state(view.frame), points, view.camera.name)
        values = np.array(annotation["keypoints"]).reshape(-1, 3)
        mask = coco.annToMask(annotation).astype(bool)
        assert annotation["num_keypoints"] == (values[:, 2] > 0).sum()
        for pixel, (u, v, flag) in zip(pixels, values, strict=True):
            seen.add(int(flag))
            inside = (pixel >= 0).all() and (pixel < (view.camera.width, view.camera.height)).all()
            assert (flag > 0) == inside
            if inside:
                assert np.abs(pixel - (u, v)).max() < 1e-3
                assert (flag == 2) == mask[int(v), int(u)]
    # Frame 1 has an empty mask: its keypoints are there and hidden.
    assert seen >= {1, 2}
    assert len(coco.getImgIds()) == 3


def test_bop_poses_put_the_models_where_the_masks_are(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "bop", tmp_path / "out")
    scene = folder / "test" / "000001"
    cameras, poses, seen = (
        json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt", "gt_info")
    )
    info, names = (json.loads((folder / "models" / f"{name}.json").read_text()) for name in ("models_info", "names"))
    models: dict[str, Any] = {key: trimesh.load(folder / "models" / f"obj_{int(key):06d}.ply") for key in names}
    camera = dataset.scene.camera(CAMERA)
    assert poses.keys() == cameras.keys() == {"0", "1", "2"} and names.keys() == info.keys()
    for key, model in models.items():
        vertices = np.asarray(model.vertices)
        assert info[key]["diameter"] <= np.linalg.norm(np.ptp(vertices, axis=0)) + 1e-6
        np.testing.assert_allclose(np.ptp(vertices, axis=0), [info[key][f"size_{axis}"] for axis in "xyz"], rtol=1e-5)
    compared = 0
    for image, found in poses.items():
        K = np.array(cameras[image]["cam_K"]).reshape(3, 3)
        np.testing.assert_allclose(K[:2, 2], camera.K[:2, 2] - HALF_PIXEL, rtol=1e-6)
        for number, (pose, counts) in enumerate(zip(found, seen[image], strict=True)):
            R, t = np.array(pose["cam_R_m2c"]).reshape(3, 3), np.array(pose["cam_t_m2c"])
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)
            stem = f"{int(image):06d}_{number:06d}.png"
            whole, visible = (
                np.asarray(cv2.imread(str(scene / kind / stem), cv2.IMREAD_GRAYSCALE)) > 0
                for kind in ("mask", "mask_visib")
            )
            assert (whole.sum(), visible.sum()) == (counts["px_count_all"], counts["px_count_visib"])
            assert not (visible & ~whole).any()
            points = np.asarray(models[str(pose["obj_id"])].vertices) @ R.T + t
            pixels = points @ K.T
            pixels = pixels[:, :2] / pixels[:, 2:] + HALF_PIXEL
            inside = ((pixels >= 1) & (pixels < (camera.width - 1, camera.height - 1))).all(1) & (points[:, 2] > 1)
            # Every vertex in the image is projected onto the link's silhouette, or at most a pixel beside it.
            grown = cv2.dilate(whole.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            columns, rows = np.floor(pixels[inside]).astype(int).T
            assert grown[rows, columns].all()
            compared += int(inside.sum())
    assert compared > 500
    assert sorted(path.name for path in (scene / "rgb").iterdir()) == [f"{n:06d}.png" for n in range(3)]
