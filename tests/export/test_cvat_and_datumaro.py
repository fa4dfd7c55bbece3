"""CVAT's and Datumaro's formats, read by what is at hand, and (slow) by Datumaro itself.

Datumaro wants an older pillow than the one that is pinned here, so it reads in an environment of its own.
"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from awkward import ARMS, Masks, assert_same_masks, expected_masks
from pycocotools import mask as coco_mask

from carts_core.export import Dataset, FormatName, export

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
def test_datumaro_itself_reads_the_very_masks(
    dataset: Dataset, tmp_path: Path, datumaro_python: Path, name: FormatName
) -> None:
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
