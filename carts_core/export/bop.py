"""BOP, the format of the benchmark for object pose estimation: 6D poses of all links, with masks and models.

There is one scene per camera (`test/000001` etc.). Each link of an arm is an object, since BOP objects are rigid.
Lengths are in millimetres.
"""

import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from scipy.spatial.distance import pdist
from trimesh.exchange.ply import export_ply

from ..files import OutputPath, write_bytes, write_text
from ..model.camera import HALF_PIXEL
from ..model.scene import Arm, SceneState
from ..rendering.rasterizer import link_transforms, rasterize, vertices_in_camera
from .dataset import Dataset, Monitor, View
from .encodings import bounding_box, mask_png

_MM = 1000.0
_NOWHERE = [-1, -1, -1, -1]
"""Bounding box that BOP assigns to objects outside the image."""


@dataclass(frozen=True)
class _Object:
    """A link as a BOP object."""

    id: int
    """Object id, from 1."""
    name: str
    link: int
    """Link index as in `View.link_ids`."""
    mesh: trimesh.Trimesh
    """Mesh in the link frame [mm]."""


def write_bop(dataset: Dataset, folder: OutputPath, monitor: Monitor) -> None:
    """Write the dataset in BOP format: poses and masks of all links in the camera's field of view."""
    objects = list(_objects(dataset.scene.arms))
    _write_models(objects, folder / "models")
    scenes: dict[str, dict[str, dict[str, Any]]] = {camera.name: defaultdict(dict) for camera in dataset.scene.cameras}
    folders = {
        camera.name: folder / "test" / f"{number:06d}" for number, camera in enumerate(dataset.scene.cameras, start=1)
    }
    for view in dataset.views(monitor):
        place, image = folders[view.camera.name], str(view.frame.index)
        scene = scenes[view.camera.name]
        scene["scene_camera"][image] = _camera(dataset, view)
        scene["scene_gt"][image], scene["scene_gt_info"][image] = _links(dataset, view, objects, place)
        dataset.write_image_as(view, place / "rgb", f"{view.frame.index:06d}")
    for camera, tables in scenes.items():
        for name, table in tables.items():
            write_text(folders[camera] / f"{name}.json", json.dumps(table))


def _objects(arms: tuple[Arm, ...]) -> Iterator[_Object]:
    """BOP objects of all links with meshes."""
    first, number = 0, 1
    for arm in arms:
        for link, name in enumerate(arm.robot.link_names):
            meshes = [mesh for mesh in arm.robot.meshes if mesh.link == link]
            if meshes:
                counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
                vertices = np.concatenate([_MM * mesh.vertices for mesh in meshes])
                faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, counts, strict=False)])
                joined = trimesh.Trimesh(vertices, faces, process=False)
                yield _Object(number, f"{arm.name}.{name}", first + link, joined)
                number += 1
        first += len(arm.robot.link_names)


def _write_models(objects: list[_Object], folder: OutputPath) -> None:
    info, names = {}, {}
    for one in objects:
        low, high = one.mesh.bounds
        entry = {"diameter": float(pdist(one.mesh.convex_hull.vertices).max())}
        entry |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
        entry |= {f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)}
        info[str(one.id)], names[str(one.id)] = entry, one.name
        write_bytes(folder / f"obj_{one.id:06d}.ply", export_ply(one.mesh))
    write_text(folder / "models_info.json", json.dumps(info, indent=1))
    write_text(folder / "names.json", json.dumps(names, indent=1, ensure_ascii=False))


def _row(dataset: Dataset, view: View) -> int:
    return dataset.scene.cameras.index(view.camera)


def _camera(dataset: Dataset, view: View) -> dict[str, Any]:
    state, row = dataset.state(view.frame), _row(dataset, view)
    fx, fy, cx, cy = state.intrinsics[row].double().tolist()
    T_view_world = state.T_view_world[row].double().numpy()
    return {
        # BOP tools follow OpenCV's convention: the centre of the first pixel is at 0.
        "cam_K": [fx, 0.0, cx - HALF_PIXEL, 0.0, fy, cy - HALF_PIXEL, 0.0, 0.0, 1.0],
        "depth_scale": 1.0,
        "cam_R_w2c": T_view_world[:3, :3].ravel().tolist(),
        "cam_t_w2c": (_MM * T_view_world[:3, 3]).tolist(),
    }


def _links(
    dataset: Dataset, view: View, objects: list[_Object], folder: OutputPath
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Write the masks of all links in the image, occluded ones included; returns their poses and visibility."""
    state, row = dataset.state(view.frame), _row(dataset, view)
    Ts = link_transforms(dataset.scene, state)[row]
    poses: list[dict[str, Any]] = []
    seen: list[dict[str, Any]] = []
    for one in objects:
        visible = view.link_ids == one.link
        whole = visible | _silhouette(dataset, view, state, Ts, one.link)
        if not whole.any():
            continue
        name = f"{view.frame.index:06d}_{len(poses):06d}.png"
        write_bytes(folder / "mask" / name, mask_png(whole))
        write_bytes(folder / "mask_visib" / name, mask_png(visible))
        T = Ts[one.link].double().numpy()
        pose = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (_MM * T[:3, 3]).tolist(), "obj_id": one.id}
        poses.append(pose)
        seen.append(
            {
                "bbox_obj": list(bounding_box(whole)),
                "bbox_visib": list(bounding_box(visible)) if visible.any() else _NOWHERE,
                "px_count_all": int(whole.sum()),
                "px_count_valid": int(whole.sum()),
                "px_count_visib": int(visible.sum()),
                "visib_fract": float(visible.sum() / whole.sum()),
            }
        )
    return poses, seen


@torch.no_grad()
def _silhouette(
    dataset: Dataset, view: View, state: SceneState, Ts: Float[torch.Tensor, "links 4 4"], link: int
) -> Bool[np.ndarray, "height width"]:
    """Silhouette of a link without occlusion."""
    geometry = dataset.renderers[view.camera.name].geometry
    own = geometry.face_links == link
    points = vertices_in_camera(geometry, Ts).mT.contiguous().numpy()
    faces, surfaces = geometry.faces[own].numpy(), geometry.face_surfaces[own].numpy()
    intrinsics = state.intrinsics[_row(dataset, view)].tolist()
    face_ids, _ = rasterize(points, faces, intrinsics, view.camera.width, view.camera.height, surfaces)
    return face_ids >= 0
