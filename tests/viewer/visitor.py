"""Somebody at the start page and in New recording: chooses, clicks in the picture, and counts the clicks."""

import csv
import re
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from playwright.sync_api import Error, Locator, Page
from waiting import wait_in

from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_viewer.start.site import Site

_DRAWS = """new Promise((done) => {
  requestAnimationFrame(() => done(true));
  setTimeout(() => done(false), 2000);
})"""
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
    """A person with a browser window; `clicks` counts what they have clicked."""

    def __init__(self, site: Site, page: Page) -> None:
        self.site, self.page = site, page
        self.clicks = 0
        self._errors: list[str] = []
        page.on("pageerror", lambda error: self._errors.append(f"{error}\n{error.stack}"))
        page.goto(site.url)

    def button(self, name: str) -> Locator:
        """A button of the document over the page."""
        return self.page.locator("main").get_by_role("button", name=name, exact=True)

    def press(self, name: str, timeout: float = 60.0) -> None:
        """Press a button as soon as it is there; `timeout` in [s]."""
        with self._explained():
            self.button(name).click(timeout=1e3 * timeout)
        self.clicks += 1

    def press_entry(self, text: str) -> None:
        """Press a line of the file browser."""
        with self._explained():
            self.page.locator("main .files button").filter(has_text=text).first.click()
        self.clicks += 1

    def press_folder(self, name: str) -> None:
        """Press a folder of the file browser, and wait until it is the one that is looked into."""
        self.press_entry(f"{name}/")
        with self._explained():
            self.page.locator("main .bar code").filter(has_text=re.compile(rf"/{re.escape(name)}$")).wait_for()

    def reads(self, text: str, timeout: float = 60.0) -> None:
        """Wait until this is to be read; `timeout` in [s]."""
        with self._explained():
            self.page.locator("main").get_by_text(text).first.wait_for(timeout=1e3 * timeout)

    def dismiss_warning(self) -> None:
        """Take away viser's note that there is no graphics card, where it lies over the picture."""
        close = self.page.locator(".mantine-Notification-closeButton")
        if close.count():
            close.first.click()

    def point_at(self, pixel: tuple[float, float], size: tuple[int, int]) -> None:
        """Click at a place of the image [px]."""
        wait_in(self.page, "window.carts && carts.imageOnScreen()")
        shown = self.page.evaluate("carts.imageOnScreen()")
        box = self.page.locator("canvas").first.bounding_box()
        assert box is not None
        x = box["x"] + shown["left"] + pixel[0] / size[0] * shown["width"]
        y = box["y"] + shown["top"] + pixel[1] / size[1] * shown["height"]
        assert 0 <= pixel[0] <= size[0] and 0 <= pixel[1] <= size[1], f"{pixel} is not in the picture"
        self.page.mouse.click(x, y)
        self.clicks += 1

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """What fails inside says what the page and the site were doing."""
        try:
            yield
        except Error as error:
            error.add_note("Errors of the page: " + ("\n".join(self._errors) or "none"))
            working = sys._current_frames().get(self.site._thread.ident or 0)
            error.add_note("The site's thread:\n" + "".join(traceback.format_stack(working)[-8:]))
            error.add_note(f"The site shows {type(self.site.shown).__name__}: {self.site.document.content[:300]}")
            error.add_note(f"The page shows: {self.page.locator('main').inner_text(timeout=5e3)[:300]}")
            connected = self.page.evaluate("Boolean(window.carts.connected())")
            error.add_note(f"It is connected: {connected}; it draws: {self.page.evaluate(_DRAWS)}")
            raise
