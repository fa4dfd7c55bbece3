"""Two arms with awkward names, the expected content of their exports, and comparisons."""

import numpy as np

from carts_core.export import Dataset, ExportProgress
from carts_core.export.dataset import View

CAMERA = "linke Kamera: ü"
ARMS = ("PSM 1", 'PSM "2" & <ü>')
SOURCES = ("measured", "rejected by Zoë", "hand, adam 4e-3")

Masks = dict[tuple[str, str], np.ndarray]
"""(Stem of the image, category) -> mask."""


def awkward(text: str) -> str:
    """The tiny sequence with a second arm beside the first one, and names with spaces, colons and umlauts."""
    head, camera = text.split("[[cameras]]")
    head, arm = head.split("[[arms]]")
    second = arm.replace('"PSM1"', f"'{ARMS[1]}'").replace(
        "[arms.joints]", f"T_world_base = {_beside().tolist()}\n[arms.joints]"
    )
    head = head.replace('frame_id = "{frame:03d}"', 'frame_id = "Bild {frame}: ä"')
    camera = camera.replace('name = "left"', f'name = "{CAMERA}"').replace(
        '"{domain}/{camera}/{frame}.png"', '"regular/left/*.png"'
    )
    return f"{head}[[arms]]{arm.replace('PSM1', ARMS[0])}[[arms]]{second}[[cameras]]{camera}"


def _beside() -> np.ndarray:
    T_world_base = np.eye(4)
    T_world_base[:3, 3] = (0.004, 0.006, 0.004)
    return T_world_base


def all_views(dataset: Dataset) -> list[View]:
    return list(dataset.views(ExportProgress()))


def expected_masks(dataset: Dataset) -> Masks:
    """What every format must give back."""
    return {
        (dataset.stems[view.id - 1], category.name): mask
        for view in all_views(dataset)
        for category, mask in dataset.instances(view)
    }


def assert_same_masks(found: Masks, expected: Masks) -> None:
    """The same objects, pixel for pixel."""
    assert found.keys() == expected.keys()
    for key, mask in expected.items():
        np.testing.assert_array_equal(found[key], mask, err_msg=str(key))
