"""Annotation formats and their encodings, read back by their own readers."""

import json
import os
import shutil
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import supervision
from awkward import ARMS, CAMERA, SOURCES, Masks, all_views, assert_same_masks, expected_masks
from PIL import Image
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from scipy.ndimage import gaussian_filter

from carts_core.export import FORMATS, Dataset, FormatName, Images, export
from carts_core.export.encodings import MIN_POINTS, bounding_box, polygons, row_runs
from carts_core.recording import Sequence
from carts_core.recording.images import read_image


def _read_coco(folder: Path) -> tuple[Any, Masks]:
    coco: Any = COCO(str(folder / "annotations" / "instances_default.json"))
    masks: Masks = {}
    for annotation in coco.anns.values():
        name = Path(coco.imgs[annotation["image_id"]]["file_name"]).stem
        masks[name, coco.cats[annotation["category_id"]]["name"]] = coco.annToMask(annotation).astype(bool)
    return coco, masks


@pytest.mark.parametrize("parts", ["arms", "links"])
def test_coco_comes_back_pixel_for_pixel(dataset: Dataset, tmp_path: Path, parts) -> None:
    dataset = replace(dataset, parts=parts)
    coco, masks = _read_coco(export(dataset, "coco", tmp_path / "out"))
    expected = expected_masks(dataset)
    assert_same_masks(masks, expected)
    assert [category["name"] for category in coco.cats.values()] == [category.name for category in dataset.categories]
    assert [image["source"] for image in coco.imgs.values()] == list(SOURCES)
    for annotation in coco.anns.values():
        left, top, width, height = annotation["bbox"]
        mask = coco.annToMask(annotation)
        assert annotation["area"] == mask.sum() == mask[top : top + height, left : left + width].sum()
        assert (
            mask[top].any() and mask[:, left].any() and mask[top + height - 1].any() and mask[:, left + width - 1].any()
        )


NAMES = [f"regular/left/00{number}.png" for number in (1, 2, 3)]
"""Of the images in the recording's folder."""


def _jpeg(dataset: Dataset) -> Dataset:
    """The dataset with JPEG images."""
    path = dataset.sequence.path
    for name in NAMES:
        file = path.parent / name
        cv2.imwrite(str(file.with_suffix(".jpg")), read_image(file)[..., ::-1])
        file.unlink()
    path.write_text(path.read_text().replace("regular/left/*.png", "regular/left/*.jpg"))
    return replace(dataset, sequence=Sequence.open(path))


def test_labels_name_the_images_of_the_recording(own_dataset: Dataset, tmp_path: Path) -> None:
    dataset = _jpeg(own_dataset)
    names = [name.replace(".png", ".jpg") for name in NAMES]
    coco, _ = _read_coco(export(dataset, "coco", tmp_path / "coco"))
    assert [image["file_name"] for image in coco.imgs.values()] == names
    assert (Path(coco.dataset["info"]["image_folder"]) / names[0]).is_file()
    cvat = ElementTree.parse(export(dataset, "cvat", tmp_path / "cvat") / "annotations.xml").getroot()
    assert [image.get("name") for image in cvat.iter("image")] == names
    content = (export(dataset, "datumaro", tmp_path / "datumaro") / "annotations" / "default.json").read_text()
    assert [item["image"]["path"] for item in json.loads(content)["items"]] == names
    assert not [path for kind in ("coco", "cvat", "datumaro") for path in (tmp_path / kind).rglob("*.[jp][pn]g")]


@pytest.mark.parametrize(
    ("name", "images", "folder"),
    [
        ("coco", "copied", "images/regular/left"),
        ("cvat", "copied", "images/regular/left"),
        ("datumaro", "copied", "images/default/regular/left"),
        ("masks", "copied", "images"),
        ("yolo", "named", "images"),
        ("voc", "named", "JPEGImages"),
        ("bop", "named", "test/000001/rgb"),
    ],
)
def test_copies_have_the_bytes_of_the_recording(
    own_dataset: Dataset, tmp_path: Path, name: FormatName, images: Images, folder: str
) -> None:
    dataset = replace(_jpeg(own_dataset), images=images)
    copies = sorted((export(dataset, name, tmp_path / "out") / folder).iterdir())
    recorded = [dataset.sequence.path.parent / name.replace(".png", ".jpg") for name in NAMES]
    assert {copy.suffix for copy in copies} == {".jpg"}
    assert [copy.read_bytes() for copy in copies] == [file.read_bytes() for file in recorded]
    without = export(replace(dataset, images="none"), name, tmp_path / "without")
    assert not (without / folder).exists()


def test_undistorted_images_are_written_with_the_labels(own_dataset: Dataset, tmp_path: Path) -> None:
    path = own_dataset.sequence.path
    path.write_text(
        path.read_text().replace('"regular/left/*.png"', '"regular/left/*.png"\ndistortion = [0.1, 0, 0, 0]')
    )
    dataset = replace(own_dataset, sequence=Sequence.open(path))
    folder = export(dataset, "coco", tmp_path / "out")
    assert dataset.remade_cameras == (CAMERA,)
    coco, _ = _read_coco(folder)
    for view, image in zip(all_views(dataset), coco.imgs.values(), strict=True):
        assert image["file_name"] == f"{view.name}.png"
        np.testing.assert_array_equal(read_image(folder / "images" / image["file_name"]), dataset.image(view))


def test_images_elsewhere_are_named_relative_to_their_folder(own_dataset: Dataset, tmp_path: Path) -> None:
    path = own_dataset.sequence.path
    (path.parent / "away").mkdir()
    moved = path.rename(path.parent / "away" / path.name)
    text = moved.read_text().replace('"regular/left/*.png"', '"../regular/left/*.png"')
    moved.write_text(text.replace('"kinematics.csv"', '"../kinematics.csv"'))
    dataset = replace(own_dataset, sequence=Sequence.open(moved))
    assert dataset.image_folder == path.parent / "regular" / "left"
    assert [dataset.image_name(view) for view in all_views(dataset)] == ["001.png", "002.png", "003.png"]


@pytest.mark.parametrize("name", [name for name, known in FORMATS.items() if not known.source])
def test_folders_whose_name_is_not_utf_8_are_exported(own_dataset: Dataset, tmp_path: Path, name: FormatName) -> None:
    folder = shutil.copytree(own_dataset.sequence.path.parent, tmp_path / os.fsdecode(b"caf\xe9"))
    dataset = replace(own_dataset, sequence=Sequence.open(folder / own_dataset.sequence.path.name))
    out = export(dataset, name, tmp_path / "out")
    if out.is_dir():
        views = json.loads((out / "export.json").read_text())["views"]
        assert [view["image"] for view in views] == [str(folder / name) for name in NAMES]
    if name == "coco":
        info = json.loads((out / "annotations/instances_default.json").read_text())["info"]
        assert info["image_folder"] == str(folder)


def test_a_folder_says_what_it_holds(dataset: Dataset, tmp_path: Path) -> None:
    said = replace(dataset.frames[2], verdict="doubtful", review="accepted", dice=0.93)
    marked = replace(dataset, frames=(*dataset.frames[:2], said))
    summary = json.loads((export(marked, "coco", tmp_path / "out") / "export.json").read_text(encoding="utf-8"))
    assert (summary["format"], summary["sequence"], summary["domain"]) == ("coco", "tiny", "regular")
    assert summary["views"][2] == {
        "name": dataset.steps[2][0],
        "frame": "Bild 3: ä",
        "index": 2,
        "camera": CAMERA,
        "image": str(dataset.image_folder / NAMES[2]),
        "source": SOURCES[2],
        "verdict": "doubtful",
        "not_determined": [],
        "review": "accepted",
        "dice": 0.93,
        "mask": "painted",
    }
    assert [summary["views"][0][key] for key in ("verdict", "review", "dice")] == [None] * 3


def _read_supervision(read: supervision.DetectionDataset) -> Masks:
    """Masks of a category in an image are joined: YOLO has an object per part."""
    masks: Masks = {}
    for path, _, detections in read:
        if len(detections):
            assert detections.mask is not None and detections.class_id is not None
            for mask, category in zip(np.asarray(detections.mask), detections.class_id, strict=True):
                key = Path(path).stem, read.classes[category]
                masks[key] = masks.get(key, np.zeros_like(mask, dtype=bool)) | mask.astype(bool)
    return masks


def _assert_within_a_pixel(found: Masks, expected: Masks) -> None:
    assert found.keys() == expected.keys()
    for key, mask in expected.items():
        grown, shrunk = (
            change(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) for change in (cv2.dilate, cv2.erode)
        )
        assert not (found[key] & ~grown).any() and not (shrunk & ~found[key]).any(), key
        assert (found[key] != mask).mean() < 1e-3, key


def test_yolo_comes_back_within_a_pixel(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "yolo", tmp_path / "out")
    read = supervision.DetectionDataset.from_yolo(
        str(folder / "images"), str(folder / "labels"), str(folder / "data.yaml"), force_masks=True
    )
    assert read.classes == list(ARMS) and len(read) == 3
    _assert_within_a_pixel(_read_supervision(read), expected_masks(dataset))


def test_yolo_is_the_same_for_readers_that_cut_fractions_off(dataset: Dataset, tmp_path: Path) -> None:
    """As Ultralytics does, which is not among the tests' packages."""
    folder = export(dataset, "yolo", tmp_path / "out")
    masks: Masks = {}
    for view in all_views(dataset):
        for line in (folder / "labels" / f"{dataset.stems[view.id - 1]}.txt").read_text().splitlines():
            category, *values = line.split()
            size = (view.camera.width, view.camera.height)
            points = (np.array(values, np.float32).reshape(-1, 2) * size).astype(np.int32)
            mask = masks.setdefault((dataset.stems[view.id - 1], ARMS[int(category)]), np.zeros(size[::-1], bool))
            mask |= cv2.fillPoly(np.zeros(size[::-1], np.uint8), [points], 1).astype(bool)
    _assert_within_a_pixel(masks, expected_masks(dataset))


def test_voc_polygons_come_back_within_a_pixel(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "voc", tmp_path / "out")
    read = supervision.DetectionDataset.from_pascal_voc(str(folder / "JPEGImages"), str(folder / "Annotations"))
    assert len(read) == 3
    _assert_within_a_pixel(_read_supervision(read), expected_masks(dataset))


def test_voc_label_images_come_back_pixel_for_pixel(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "voc", tmp_path / "out")
    names = (folder / "ImageSets" / "Segmentation" / "trainval.txt").read_text(encoding="utf-8").split()
    assert names == ["001", "002", "003"]
    for view in all_views(dataset):
        image = Image.open(folder / "SegmentationClass" / f"{dataset.stems[view.id - 1]}.png")
        assert image.mode == "P" and (image.getpalette() or [])[:9] == [0, 0, 0, 128, 0, 0, 0, 128, 0]
        np.testing.assert_array_equal(np.array(image), dataset.label_image(view))
        objects = np.array(Image.open(folder / "SegmentationObject" / f"{dataset.stems[view.id - 1]}.png"))
        np.testing.assert_array_equal(objects > 0, view.link_ids >= 0)
        assert objects.max() == len(list(dataset.instances(view)))


def test_png_masks_come_back_pixel_for_pixel(dataset: Dataset, tmp_path: Path) -> None:
    folder = export(dataset, "masks", tmp_path / "out")
    meaning = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
    assert list(meaning["arms"].values()) == ["background", *ARMS]
    for view in all_views(dataset):
        kinds = ("binary", "arms", "parts", "links")
        read = {kind: np.array(Image.open(folder / kind / f"{view.name}.png")) for kind in kinds}
        np.testing.assert_array_equal(read["parts"], dataset.label_image(view, "parts"))
        np.testing.assert_array_equal(read["binary"], np.where(view.link_ids >= 0, 255, 0))
        np.testing.assert_array_equal(read["links"].astype(int), view.link_ids + 1)
        for value, name in meaning["links"].items():
            arm = next((number for number, arm in enumerate(ARMS, 1) if name.startswith(arm)), 0)
            assert set(np.unique(read["arms"][read["links"] == int(value)])) <= {arm}


DATUMARO = "datumaro==1.13.12"

_READER = """
import sys
import numpy as np
import datumaro

format, folder, output = sys.argv[1:]
dataset = datumaro.Dataset.import_from(folder, format)
names = [label.name for label in dataset.categories()[datumaro.AnnotationType.label]]
masks, images = {}, 0
for item in dataset:
    images += item.media.data is not None
    for annotation in item.annotations:
        if annotation.type == datumaro.AnnotationType.mask:
            masks[item.id.split("/")[-1] + "|" + names[annotation.label]] = np.asarray(annotation.image, dtype=bool)
np.savez(output, images=images, keys=np.array(sorted(masks)), masks=np.array([masks[key] for key in sorted(masks)]))
"""


def test_cvat_comes_back_pixel_for_pixel(dataset: Dataset, tmp_path: Path) -> None:
    root = ElementTree.parse(export(dataset, "cvat", tmp_path / "out") / "annotations.xml").getroot()
    assert root.findtext("version") == "1.1" and root.findtext("meta/task/size") == "3"
    assert [label.findtext("name") for label in root.iter("label")] == list(ARMS)
    masks: Masks = {}
    for number, image in enumerate(root.iter("image")):
        assert image.get("id") == str(number) and (dataset.image_folder / image.get("name", "")).is_file()
        height, width = int(image.get("height", "")), int(image.get("width", ""))
        for entry in image.iter("mask"):
            left, top, columns, rows = (int(entry.get(key, "")) for key in ("left", "top", "width", "height"))
            runs = [int(run) for run in entry.get("rle", "").split(",")]
            crop = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(rows, columns)
            mask = np.zeros((height, width), bool)
            mask[top : top + rows, left : left + columns] = crop
            masks[Path(image.get("name", "")).stem, entry.get("label", "")] = mask
    assert_same_masks(masks, expected_masks(dataset))


def test_datumaro_comes_back_pixel_for_pixel(dataset: Dataset, tmp_path: Path) -> None:
    file = export(dataset, "datumaro", tmp_path / "out") / "annotations" / "default.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    labels = [label["name"] for label in content["categories"]["label"]["labels"]]
    assert labels == list(ARMS) and len(content["items"]) == 3
    masks: Masks = {}
    for item in content["items"]:
        assert (dataset.image_folder / item["image"]["path"]).is_file()
        for annotation in item["annotations"]:
            masks[Path(item["id"]).name, labels[annotation["label_id"]]] = coco_mask.decode(annotation["rle"]).astype(
                bool
            )
    assert_same_masks(masks, expected_masks(dataset))


@pytest.fixture(scope="session")
def datumaro_python(pytestconfig: pytest.Config) -> Path:
    """An interpreter that has Datumaro; made once, kept in pytest's cache."""
    assert pytestconfig.cache is not None
    folder = Path(pytestconfig.cache.mkdir("datumaro")) / DATUMARO
    if not (folder / "ready").is_file():
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        pip = [folder / "bin" / "python", "-m", "pip", "install", "-q", DATUMARO]
        finished = subprocess.run(pip, capture_output=True, text=True, check=False)
        if finished.returncode:
            pytest.skip(f"{DATUMARO} cannot be installed here: {finished.stderr[-300:]}")
        (folder / "ready").touch()
    return folder / "bin" / "python"


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["cvat", "datumaro", "coco", "voc"])
def test_datumaro_reads_the_masks(dataset: Dataset, tmp_path: Path, datumaro_python: Path, name: FormatName) -> None:
    dataset = replace(dataset, images="copied")
    folder, output = export(dataset, name, tmp_path / "out"), tmp_path / "read.npz"
    finished = subprocess.run(
        [datumaro_python, "-c", _READER, name, folder, output], capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr
    with np.load(output) as read:
        assert read["images"] == 3
        masks = {tuple(key.split("|")): mask for key, mask in zip(read["keys"].tolist(), read["masks"], strict=True)}
    assert_same_masks(masks, expected_masks(dataset))


_BOX_READER = """
import json, sys
import datumaro

folder = sys.argv[1]
dataset = datumaro.Dataset.import_from(folder)
names = [label.name for label in dataset.categories()[datumaro.AnnotationType.label]]
boxes = [[item.id, names[box.label], *map(round, box.get_bbox())] for item in dataset for box in item.annotations]
shapes = {item.id: item.media.data.shape[:2] for item in dataset}
print(json.dumps([datumaro.Environment().detect_dataset(folder), shapes, sorted(boxes)]))
"""


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_datumaro_recognizes_yolo_and_reads_the_boxes(dataset: Dataset, tmp_path: Path, datumaro_python: Path) -> None:
    """Of images without arms too; Datumaro has no reader of YOLO polygons."""
    folder = export(dataset, "yolo", tmp_path / "out")
    finished = subprocess.run([datumaro_python, "-c", _BOX_READER, folder], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    formats, shapes, boxes = json.loads(finished.stdout)
    expected = {key: bounding_box(mask) for key, mask in expected_masks(dataset).items()}
    assert formats == ["yolo"] and len(shapes) == 3
    assert boxes == [[*key, *box] for key, box in sorted(expected.items())]


def _filled(mask: np.ndarray) -> np.ndarray:
    filled = np.zeros(mask.shape, np.uint8)
    for polygon in polygons(mask):
        cv2.fillPoly(filled, [polygon.astype(np.int32)], 1)
    return filled.astype(bool)


def _blobs(seed: int) -> np.ndarray:
    """Random islands with holes, and islands in the holes."""
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal((90, 120)), 3.0)
    return np.abs(noise) > 0.6 * noise.std()


@pytest.mark.parametrize("seed", range(6))
def test_filling_gives_the_mask_back_within_a_pixel(seed: int) -> None:
    mask = _blobs(seed)
    wrong = _filled(mask) != mask
    # Along a slanted slit a pixel of a hole's rim may be hit; nothing is further than a pixel off.
    near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert not (wrong & ~near).any() and not (wrong & mask).any()
    assert wrong.mean() < 1e-3


def test_a_mask_with_many_holes_takes_little_memory_and_comes_back() -> None:
    mask = np.pad(np.random.default_rng(0).random((200, 300)) > 0.01, 4)
    tracemalloc.start()
    filled = _filled(mask)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 50 * 2**20
    np.testing.assert_array_equal(filled, mask)


@pytest.mark.parametrize(
    "mask",
    [
        np.ones((1, 1), bool),
        np.ones((1, 5), bool),
        np.eye(4, dtype=bool),
        np.pad(np.ones((7, 9), bool), 2),
        np.pad(np.pad(np.zeros((3, 3), bool), 1, constant_values=True), 1),
        np.pad(np.pad(np.zeros((3, 6), bool), 4, constant_values=True), 1),
    ],
    ids=["pixel", "line", "diagonal", "rectangle", "thin ring", "thick ring"],
)
def test_simple_shapes_come_back_exactly(mask: np.ndarray) -> None:
    assert all(len(polygon) >= MIN_POINTS for polygon in polygons(mask))
    np.testing.assert_array_equal(_filled(mask), mask)


@pytest.mark.parametrize("seed", range(3))
def test_row_runs_alternate_from_outside(seed: int) -> None:
    mask = _blobs(seed)
    runs = row_runs(mask)
    inside = np.arange(len(runs)) % 2 == 1
    np.testing.assert_array_equal(np.repeat(inside, runs).reshape(mask.shape), mask)
    assert row_runs(np.ones((2, 2), bool)) == [0, 4]
