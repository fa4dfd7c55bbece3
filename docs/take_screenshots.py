"""Take the README's picture: the shipped sample after a perturbation of 2 degrees and a run of the optimizer.

    python docs/take_screenshots.py

Needs the development tools and Chromium (`CARTS_CHROMIUM` or on the path).
"""

import os
import shutil
import tempfile
import time
from pathlib import Path

import cv2
from playwright.sync_api import sync_playwright

from carts_core.resources import sample_sequence
from carts_core.threads import leave_a_core_free
from carts_viewer import intents as ask
from carts_viewer.app import ViewerApp
from carts_viewer.layers import Layer
from carts_viewer.state import Phase

IMAGES = Path(__file__).parent / "images"
FLAGS = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"]


def main() -> None:
    """Write docs/images/viewer.png."""
    leave_a_core_free()
    chromium = os.environ.get("CARTS_CHROMIUM") or shutil.which("chromium")
    with (
        tempfile.TemporaryDirectory() as folder,
        ViewerApp.open(sample_sequence(), project=Path(folder) / "pictured.carts", port=0) as app,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": 1440, "height": 860})
        page.goto(app.url)
        page.wait_for_function("window.__viserMutable?.nodeRefFromName['/frame'] && window.carts", timeout=60_000)
        for intent in (ask.ShowFrame(1), ask.ShowLayer(Layer.MASK), ask.Perturb(2.0, 0), ask.Run()):
            app.mailbox.put(intent)
            app.wait_until_shown(300)
        while app.state.run.phase is Phase.RUNNING:
            time.sleep(0.5)
        close = page.locator(".mantine-Notification-closeButton")
        if close.count():
            close.first.click()
        time.sleep(3)
        IMAGES.mkdir(exist_ok=True)
        page.screenshot(path=IMAGES / "viewer.png")
        browser.close()
    image = cv2.imread(str(IMAGES / "viewer.png"))
    assert image is not None
    cv2.imwrite(str(IMAGES / "viewer.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
