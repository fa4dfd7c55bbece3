"""Take the screenshots of the README and the tutorial, on the shipped sample, in the order of the tutorial.

    make pictures

Needs the development tools and Chromium (`CARTS_CHROMIUM` or on the path). Run it again
when the page changes.
"""

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, ViewportSize, sync_playwright

from carts_core.model.keypoints import project_keypoints
from carts_core.process import tune_process
from carts_core.resources import sample_sequence
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.overlay import labelled_keypoints
from carts_viewer.picture.strokes import Stroke, Target, Tool
from carts_viewer.state import Phase

IMAGES = Path(__file__).parent / "images"
WINDOW: ViewportSize = {"width": 1280, "height": 800}
QUALITY = 82
PATIENCE = 600.0
"""Timeout of each step [s]."""
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"]


class Photographer:
    """Drives a viewer and takes screenshots of its page."""

    def __init__(self, app: ViewerApp, page: Page) -> None:
        self.app, self.page = app, page
        page.goto(app.url)
        page.wait_for_function("window.__viserMutable?.nodeRefFromName['/overlay'] && window.carts", timeout=60_000)
        # Close the warning that this browser has no graphics card.
        page.locator(".mantine-Notification-closeButton").click(timeout=30_000)

    def do(self, *intents: intents.Intent) -> None:
        for intent in intents:
            self.app.queue.put(intent)
            self.app.wait_until_shown(PATIENCE)

    def wait(self, reached: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not reached():
            if time.monotonic() > end:
                raise TimeoutError(f"Not reached in {PATIENCE} s.")
            time.sleep(0.2)

    def run(self) -> None:
        self.do(intents.Run())
        self.wait(lambda: self.app.state.run.phase is Phase.IDLE)

    def tab(self, name: str) -> None:
        self.page.get_by_text(name, exact=True).first.click()

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a list."""
        self.page.locator(f"[id='{self.app.page.element_id(self.app.view.page.find(label))}']").click()
        self.page.get_by_role("option", name=option, exact=True).click()
        self.page.wait_for_timeout(500)

    def picture(self, name: str) -> None:
        """Write `images/NAME.jpg` of the whole page."""
        # Below the image and above the timeline, where the pointer changes nothing.
        self.page.mouse.move(WINDOW["width"] / 2, 650)
        self.page.wait_for_timeout(2500)
        self.page.screenshot(path=IMAGES / f"{name}.jpg", type="jpeg", quality=QUALITY)

    def click_keypoints(self, *names: str) -> None:
        """Place these keypoints at their true positions, which the sample includes."""
        scene, state = self.app.scene, self.app.state
        points = labelled_keypoints(scene)
        truth = scene.state(state.frame.truth or {})
        pixels = project_keypoints(scene, truth, [points[name] for name in names], state.camera).tolist()
        for name, (u, v) in zip(names, pixels, strict=True):
            self.do(intents.ChooseKeypoint(name), intents.PointAt(u, v), intents.Released())
        self.do(intents.ChooseKeypoint(None))

    def paint(self, target: Target, *points: tuple[float, float], polygon: bool = False) -> None:
        """Paint a stroke or polygon through these points of the image [px]."""
        state = self.app.state
        stroke = Stroke(0, state.index, state.camera, target, False, polygon, 24, np.array(points))
        self.do(intents.Paint(-1, stroke))


def take(work: Photographer) -> None:
    """All pictures, in the tutorial's order."""
    app = work.app
    work.picture("start")
    work.do(intents.Perturb(2.0, 0))
    work.run()
    work.picture("run")
    work.do(intents.ShowFrame(1), intents.Perturb(5.0, 0))
    work.do(intents.SetTool(Tool.KEYPOINT))
    work.click_keypoints("psm1 jaw 1 tip", "psm1 wrist pitch joint")
    work.picture("keypoints")
    work.click_keypoints("psm2 jaw 1 tip", "psm2 wrist pitch joint")
    work.run()
    work.do(intents.ShowKeypoints(False))
    work.do(intents.SetTool(Tool.BRUSH))
    work.paint(Target.MASK, (150, 90), (200, 100), (260, 96))
    work.paint(Target.IGNORE, (430, 330), (520, 320), (560, 400), (450, 430), polygon=True)
    work.picture("paint")
    work.do(
        intents.SetTool(Tool.SELECT),
        intents.Undo(),
        intents.Undo(),
        intents.ShowFrame(0),
        intents.AcceptAndNext(),
        intents.AcceptAndNext(),
        intents.ShowFrame(8),
    )
    work.run()
    work.do(intents.SetKeyframe(True), intents.ShowFrame(5), intents.Solve())
    work.wait(lambda: not app.state.solving)
    work.tab("Review")
    work.picture("solve")
    work.do(
        intents.ShowFrame(2),
        *[intents.AcceptAndNext()] * 5,
        intents.SetNote("check the jaw of psm2"),
        intents.Released(),
    )
    work.picture("review")
    work.tab("Export")
    work.choose("Format", "COCO")
    work.choose("Frames", "Accepted")
    work.page.get_by_role("button", name="Export", exact=True).click()
    work.wait(lambda: app.state.export is not None and app.state.export.path is not None)
    work.picture("export")


def main() -> None:
    """Write docs/images/*.jpg."""
    tune_process()
    chromium = os.environ.get("CARTS_CHROMIUM") or shutil.which("chromium")
    IMAGES.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="carts_") as folder,
        ViewerApp.open(sample_sequence(), project=Path(folder) / "sample.carts", port=0) as app,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport=WINDOW, bypass_csp=True)  # for wait_for_function
        page.add_init_script("localStorage.setItem('carts-tour', 'seen')")
        take(Photographer(app, page))
        browser.close()
    for path in sorted(IMAGES.glob("*.jpg")):
        print(f"{path.name}: {path.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
