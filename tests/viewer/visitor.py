"""A user at the start page and in New recording: chooses, clicks in the picture, and counts the clicks."""

import csv
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from playwright.sync_api import Locator, Page
from viewer_tab import box_of
from waiting import wait_in

from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_viewer.start.site import Site

_YAML = """image_width: {width}
image_height: {height}
camera_name: {name}
camera_matrix: {{rows: 3, cols: 3, data: {matrix}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""


def write_lab_files(
    folder: Path,
    frames: Sequence[int],
    positions: np.ndarray,
    cameras: Iterable[tuple[str, tuple[int, int], np.ndarray]],
) -> None:
    """A table in degrees and millimetres under names of its own, and a ROS calibration for each camera.

    Args:
        folder: where images are already.
        frames: numbers of the images.
        positions: of the joints, a row per image [rad, m].
        cameras: name, width and height [px], and K with OpenCV's pixel centres.
    """
    scaled = positions[:, :6] * np.where(np.arange(6) == JOINT_NAMES.index("insertion"), 1e3, 180 / np.pi)
    with (folder / "robot_log.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["picture", *(f"axis_{number}" for number in range(1, 7))])
        writer.writerows([frame, *(f"{value:.6f}" for value in row)] for frame, row in zip(frames, scaled, strict=True))
    for name, (width, height), K in cameras:
        text = _YAML.format(width=width, height=height, name=name, matrix=K.ravel().tolist())
        (folder / f"{name}.yaml").write_text(text)


class Visitor:
    """A user with a browser window; `clicks` counts the clicks."""

    def __init__(self, site: Site, page: Page) -> None:
        self.site, self.page = site, page
        self.clicks = 0
        page.goto(site.url)

    def button(self, name: str) -> Locator:
        """A button of the document over the page."""
        return self.page.locator("main").get_by_role("button", name=name, exact=True)

    def press(self, name: str, timeout: float = 60.0) -> None:
        """Press a button as soon as it exists; `timeout` in [s]."""
        self.button(name).click(timeout=1e3 * timeout)
        self.clicks += 1

    def press_folder(self, name: str) -> None:
        """Press a folder of the file browser, and wait until it is the shown one."""
        self.page.locator("main .files button").filter(has_text=f"{name}/").first.click()
        self.clicks += 1
        self.page.locator("main .bar code").filter(has_text=re.compile(rf"/{re.escape(name)}$")).wait_for()

    def reads(self, text: str, timeout: float = 60.0) -> None:
        """Wait until this is to be read; `timeout` in [s]."""
        self.page.locator("main").get_by_text(text).first.wait_for(timeout=1e3 * timeout)

    def point_at(self, pixel: tuple[float, float], size: tuple[int, int]) -> None:
        """Click at a point of the image [px]."""
        wait_in(self.page, "window.carts && carts.imageOnScreen()")
        shown, box = self.page.evaluate("carts.imageOnScreen()"), box_of(self.page.locator("canvas"))
        x = box["x"] + shown["left"] + pixel[0] / size[0] * shown["width"]
        y = box["y"] + shown["top"] + pixel[1] / size[1] * shown["height"]
        assert 0 <= pixel[0] <= size[0] and 0 <= pixel[1] <= size[1], f"{pixel} is not in the picture"
        self.page.mouse.click(x, y)
        self.clicks += 1
