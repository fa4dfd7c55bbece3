"""Export formats of annotation tools and of pose benchmarks: masks, COCO, YOLO, VOC, CVAT, Datumaro and BOP."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from PIL import Image
from scipy.spatial.distance import pdist
from trimesh.exchange.ply import export_ply

from ..errors import CartsError
from ..files import OutputPath, output_stream, write_bytes, write_text
from ..model.camera import opencv_matrix
from ..model.keypoints import Keypoint, keypoints, project_keypoints
from ..model.scene import Arm, SceneState
from ..rendering.rasterizer import link_transforms, rasterize, vertices_in_camera
from ..settings import Parts
from .dataset import Category, Dataset, ExportProgress, View
from .encodings import bounding_box, coco_rle, label_png, mask_png, polygons, row_runs

_KINDS: tuple[Parts, ...] = ("arms", "parts", "links")


def write_masks(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write PNG masks into `binary`, `arms`, `parts` and `links`; `labels.json` maps pixel values to categories."""
    for view in dataset.views(progress):
        if dataset.images == "copied":
            dataset.write_image_as(view, folder / "images", view.name)
        write_bytes(folder / "binary" / f"{view.name}.png", mask_png(view.link_ids >= 0))
        for kind in _KINDS:
            write_bytes(folder / kind / f"{view.name}.png", label_png(dataset.label_image(view, kind)))
    meaning = {"binary": {0: "background", 255: "arm"}}
    for kind in _KINDS:
        meaning[kind] = {0: "background"} | {category.id: category.name for category in dataset.categories_of(kind)}
    write_text(folder / "labels.json", json.dumps(meaning, indent=1, ensure_ascii=False))


Annotation = dict[str, Any]


def write_coco(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the dataset in COCO format, with lossless masks."""

    def annotations(view: View) -> Iterable[Annotation]:
        for category, mask in dataset.instances(view):
            yield mask_annotation(view, category.id, mask)

    categories = [{"id": c.id, "name": c.name, "supercategory": c.arm} for c in dataset.categories]
    write_annotations(dataset, folder, progress, "instances", categories, annotations)


def mask_annotation(view: View, category_id: int, mask: Bool[ndarray, "height width"]) -> Annotation:
    """Create the annotation of an object in a view, without id; the box of an invisible object is empty."""
    return {
        "image_id": view.id,
        "category_id": category_id,
        "segmentation": coco_rle(mask),
        "area": int(mask.sum()),
        "bbox": list(bounding_box(mask)) if mask.any() else [0, 0, 0, 0],
        "iscrowd": 0,
    }


def write_annotations(
    dataset: Dataset,
    folder: OutputPath,
    progress: ExportProgress,
    kind: str,
    categories: list[dict[str, Any]],
    annotate: Callable[[View], Iterable[Annotation]],
) -> None:
    """Write images and a COCO annotation file with the name that CVAT and Datumaro expect.

    Args:
        kind: `instances` or `person_keypoints`, the prefix of COCO's file names.
        categories: categories in COCO format.
        annotate: returns the annotations of a view, without ids.
    """
    images, annotations = [], []
    for view in dataset.views(progress):
        images.append(
            {
                "id": view.id,
                "file_name": dataset.write_image(view, folder / "images"),
                "width": view.camera.width,
                "height": view.camera.height,
                "frame": view.frame.frame_id,
                "camera": view.camera.name,
                "source": view.frame.source,
                **({view.mask: True} if view.mask != "rendered" else {}),
            }
        )
        for annotation in annotate(view):
            annotations.append({"id": len(annotations) + 1, **annotation})
    content = {
        "info": {"description": dataset.sequence.name, "image_folder": str(dataset.image_folder)},
        "licenses": [],
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }
    # Non-ASCII characters are escaped, since paths need not be UTF-8.
    write_text(folder / "annotations" / f"{kind}_default.json", json.dumps(content))


_OUTSIDE, _HIDDEN, _VISIBLE = 0, 1, 2
"""Visibility flags of COCO: not labelled, labelled but not visible, labelled and visible."""


def write_coco_keypoints(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write keypoints, mask and box of every arm in COCO format, with one category per arm."""
    points = {arm.name: keypoints(arm) for arm in dataset.scene.arms}

    def annotations(view: View) -> Iterable[Annotation]:
        for category in dataset.arms:
            yield from _annotations(dataset, view, category, points[category.arm])

    categories = [_category(category, points[category.arm]) for category in dataset.arms]
    # CVAT and Datumaro expect "person" in the file name for all kinds of objects.
    write_annotations(dataset, folder, progress, "person_keypoints", categories, annotations)


def _category(category: Category, points: tuple[Keypoint, ...]) -> dict[str, Any]:
    names = [point.name for point in points]
    tips = [number for number, name in enumerate(names, start=1) if name.endswith(" tip")]
    joints = [number for number in range(1, len(names) + 1) if number not in tips]
    # The joints are a chain along the instrument; every tip is connected to its nearest joint.
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
    """Annotation of an arm in a view; empty if neither pixels nor keypoints of the arm are in the image."""
    mask = dataset.label_image(view, "arms") == category.id
    pixels = project_keypoints(dataset.scene, dataset.state(view.frame), points, view.camera.name)
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


def _element(tag: str, content: object) -> ElementTree.Element:
    """Create an XML element with text, or with one child per entry of a mapping and per item of a list."""
    element = ElementTree.Element(tag)
    if isinstance(content, Mapping):
        for name, value in content.items():
            element.extend(_element(name, one) for one in (value if isinstance(value, list) else [value]))
    else:
        element.text = str(content)
    return element


def _xml(root: ElementTree.Element) -> bytes:
    """Serialize an element as indented XML."""
    ElementTree.indent(root, " ")
    return ElementTree.tostring(root, encoding="utf-8")


def write_cvat(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the dataset in CVAT format, with lossless masks."""
    labels = [{"name": category.name, "type": "mask", "attributes": ""} for category in dataset.categories]
    task = {
        "name": dataset.sequence.name,
        "size": len(dataset.steps),
        "mode": "annotation",
        "labels": {"label": labels},
    }
    root = _element("annotations", {"version": "1.1", "meta": {"task": task}})
    for view in dataset.views(progress):
        size = {"width": str(view.camera.width), "height": str(view.camera.height)}
        name = dataset.write_image(view, folder / "images")
        image = ElementTree.SubElement(root, "image", {"id": str(view.id - 1), "name": name, **size})
        for category, mask in dataset.instances(view):
            left, top, width, height = bounding_box(mask)
            runs = row_runs(mask[top : top + height, left : left + width])
            attributes = {"label": category.name, "source": "auto", "occluded": "0", "rle": ", ".join(map(str, runs))}
            box = {"left": str(left), "top": str(top), "width": str(width), "height": str(height), "z_order": "0"}
            ElementTree.SubElement(image, "mask", {**attributes, **box})
    write_bytes(folder / "annotations.xml", b"<?xml version='1.0' encoding='utf-8'?>\n" + _xml(root))


_IMAGE = 2
"""Datumaro's media type of still images."""


def write_datumaro(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the dataset in Datumaro format, with lossless masks."""
    items = []
    for view in dataset.views(progress):
        file = dataset.write_image(view, folder / "images" / "default")
        annotations = [
            {
                **{"id": number, "type": "mask", "attributes": {}, "group": 0},
                **{"label_id": category.id - 1, "rle": coco_rle(mask), "z_order": 0},
            }
            for number, (category, mask) in enumerate(dataset.instances(view))
        ]
        item = {"id": str(PurePosixPath(file).with_suffix("")), "annotations": annotations}
        item["attr"] = {"frame": view.frame.frame_id, "camera": view.camera.name, "source": view.frame.source}
        item["image"] = {"path": file, "size": [view.camera.height, view.camera.width]}
        items.append(item)
    labels = [{"name": category.name, "parent": "", "attributes": []} for category in dataset.categories]
    content = {
        "dm_format_version": "1.0",
        "media_type": _IMAGE,
        "infos": {},
        "categories": {"label": {"labels": labels, "label_groups": [], "attributes": []}},
        "items": items,
    }
    write_text(folder / "annotations" / "default.json", json.dumps(content, ensure_ascii=False))


_LISTS = ("Main", "Segmentation")
"""Folders in `ImageSets` with image lists; each list contains all images, since there is no split."""
_MAX_CATEGORIES = 254
"""Maximum number of categories; 0 is the background, and 255 is VOC's void."""


def write_voc(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the dataset in Pascal VOC format, with lossless label images; images keep their file format."""
    if len(dataset.categories) > _MAX_CATEGORIES:
        raise CartsError(
            f"Pascal VOC supports at most {_MAX_CATEGORIES} categories; given: {len(dataset.categories)}. "
            "Export COCO instead."
        )
    for view in dataset.views(progress):
        stem = dataset.stems[view.id - 1]
        file = dataset.write_image_as(view, folder / "JPEGImages", stem)
        objects = np.zeros(view.link_ids.shape, np.uint8)
        entries = []
        for number, (category, mask) in enumerate(dataset.instances(view), start=1):
            objects[mask] = number
            entries.append(_object(category, mask))
        size = {"width": view.camera.width, "height": view.camera.height, "depth": 3}
        content = {"folder": "JPEGImages", "filename": file, "size": size, "segmented": 1, "object": entries}
        _write_palette(folder / "SegmentationClass" / f"{stem}.png", dataset.label_image(view))
        _write_palette(folder / "SegmentationObject" / f"{stem}.png", objects)
        write_bytes(folder / "Annotations" / f"{stem}.xml", _xml(_element("annotation", content)))
    names = "".join(f"{stem}\n" for stem in dataset.stems)
    for name in _LISTS:
        write_text(folder / "ImageSets" / name / "trainval.txt", names)
    colors = [",".join(map(str, color)) for color in _palette().tolist()]
    names = ["background", *(_name(category) for category in dataset.categories)]
    lines = ["# label:color_rgb:parts:actions\n", *(f"{name}:{colors[n]}::\n" for n, name in enumerate(names))]
    write_text(folder / "labelmap.txt", "".join(lines))


def _object(category: Category, mask: np.ndarray) -> dict[str, Any]:
    """VOC entry of an object; VOC counts pixels from 1."""
    left, top, width, height = bounding_box(mask)
    outlines = [
        {f"{'xy'[axis]}{number + 1}": value + 1 for (number, axis), value in np.ndenumerate(polygon)}
        for polygon in polygons(mask)
    ]
    return {
        "name": _name(category),
        **{"pose": "Unspecified", "truncated": 0, "difficult": 0, "occluded": 0},
        "bndbox": {"xmin": left + 1, "ymin": top + 1, "xmax": left + width, "ymax": top + height},
        "polygon": outlines,
    }


def _name(category: Category) -> str:
    return category.name.replace(":", "_")  # a colon separates the columns of labelmap.txt


def _palette() -> UInt8[np.ndarray, "256 3"]:
    """VOC's colour map: the bits of a label, from the lowest, are assigned to red, green and blue in turn, from the
    highest bit of these."""
    labels = np.arange(256)[:, None]
    bits = (labels >> np.arange(8)) & 1
    return np.stack(
        [sum(bits[:, 3 * n + c] << (7 - n) for n in range(3) if 3 * n + c < 8) for c in range(3)], 1
    ).astype(np.uint8)


def _write_palette(path: OutputPath, labels: UInt8[np.ndarray, "height width"]) -> None:
    image = Image.fromarray(labels, mode="L")
    image.putpalette(_palette().tobytes())  # converts grey values to palette indices
    with output_stream(path) as stream:
        image.save(stream, format="PNG")


_INTO_PIXEL = 0.25
"""Offset added to pixel indices [px], so that rounding (supervision) and truncation (Ultralytics) both recover the
pixel.
"""


def write_yolo(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the dataset in YOLO format; each connected visible region of a category is an object.

    Datumaro reads YOLO boxes, but no polygons: for Datumaro, `annotations/` has a box per category, and `obj.names` the
    names of the categories. Views without a visible category have no file in `annotations/`, since Datumaro also reads
    their empty files in `labels/`.
    """
    for view in dataset.views(progress):
        stem = dataset.stems[view.id - 1]
        dataset.write_image_as(view, folder / "images", stem)
        size = (view.camera.width, view.camera.height)
        lines, boxes = [], []
        for category, mask in dataset.instances(view):
            left, top, width, height = bounding_box(mask)
            centre_and_size = np.array([[left + 0.5 * width, top + 0.5 * height], [width, height]])
            boxes.append(_yolo_line(category, centre_and_size / size))
            lines += [_yolo_line(category, (polygon + _INTO_PIXEL) / size) for polygon in polygons(mask)]
        write_text(folder / "labels" / f"{stem}.txt", "".join(lines))
        if boxes:
            write_text(folder / "annotations" / f"{stem}.txt", "".join(boxes))
    categories = [category.name for category in dataset.categories]
    write_text(folder / "obj.names", "".join(f"{name}\n" for name in categories))
    names = json.dumps(categories, ensure_ascii=False)  # JSON is valid YAML
    text = f"# Not split: both contain all images.\ntrain: images\nval: images\nnames: {names}\n"
    write_text(folder / "data.yaml", text)


def _yolo_line(category: Category, numbers: Float[np.ndarray, "pairs 2"]) -> str:
    return f"{category.id - 1} {' '.join(f'{number:.6f}' for number in numbers.ravel())}\n"


_MM = 1000.0
_NOWHERE = [-1, -1, -1, -1]
"""Bounding box that BOP assigns to objects without visible pixels."""


@dataclass(frozen=True)
class _Object:
    """Link as a BOP object."""

    id: int
    """Object id, from 1."""
    name: str
    link: int
    """Link index as in `View.link_ids`."""
    mesh: trimesh.Trimesh
    """Mesh in the link frame [mm]."""


def write_bop(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write the dataset in BOP format: models, and 6D poses and masks of all links in the camera's field of view.

    Each camera is a scene (`test/000001` etc.), and each link of an arm an object, since BOP objects are rigid.
    Lengths are in millimetres.
    """
    objects = list(_bop_objects(dataset.scene.arms))
    _write_models(objects, folder / "models")
    scenes: dict[str, dict[str, dict[str, Any]]] = {camera.name: defaultdict(dict) for camera in dataset.scene.cameras}
    folders = {
        camera.name: folder / "test" / f"{number:06d}" for number, camera in enumerate(dataset.scene.cameras, start=1)
    }
    for view in dataset.views(progress):
        place, image = folders[view.camera.name], str(view.frame.index)
        scene = scenes[view.camera.name]
        scene["scene_camera"][image] = _bop_camera(dataset, view)
        scene["scene_gt"][image], scene["scene_gt_info"][image] = _bop_links(dataset, view, objects, place)
        dataset.write_image_as(view, place / "rgb", f"{view.frame.index:06d}")
    for camera, tables in scenes.items():
        for name, table in tables.items():
            write_text(folders[camera] / f"{name}.json", json.dumps(table))


def _bop_objects(arms: tuple[Arm, ...]) -> Iterator[_Object]:
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


def _bop_camera(dataset: Dataset, view: View) -> dict[str, Any]:
    state, row = dataset.state(view.frame), _row(dataset, view)
    T_view_world = state.T_view_world[row].astype(np.float64)
    return {
        # BOP tools follow OpenCV's convention: the centre of the first pixel is at 0.
        "cam_K": opencv_matrix(state.intrinsics[row].tolist()).ravel().tolist(),
        "depth_scale": 1.0,
        "cam_R_w2c": T_view_world[:3, :3].ravel().tolist(),
        "cam_t_w2c": (_MM * T_view_world[:3, 3]).tolist(),
    }


def _bop_links(
    dataset: Dataset, view: View, objects: list[_Object], folder: OutputPath
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Write the masks of all links in the image, including occluded links; returns their poses and visibility."""
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
        T = Ts[one.link].astype(np.float64)
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


def _silhouette(
    dataset: Dataset, view: View, state: SceneState, Ts: Float[ndarray, "links 4 4"], link: int
) -> Bool[np.ndarray, "height width"]:
    """Silhouette of a link without occlusion."""
    geometry = dataset.renderers[view.camera.name].geometry
    own = geometry.face_links == link
    points = vertices_in_camera(geometry, Ts).T
    faces, surfaces = geometry.faces[own], geometry.face_surfaces[own]
    intrinsics = state.intrinsics[_row(dataset, view)].tolist()
    face_ids, _ = rasterize(points, faces, intrinsics, view.camera.width, view.camera.height, surfaces)
    return face_ids >= 0
