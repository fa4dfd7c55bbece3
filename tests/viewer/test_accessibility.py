"""Pages checked with axe-core, in both themes: no serious or critical finding.

Set CARTS_AXE to axe.min.js of the npm package axe-core (`npm pack axe-core`, then unpack).
"""

import os
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from clicked_points import clicked
from playwright.sync_api import Browser, Page, expect
from viewer_tab import OpenTab, dismiss_warning, new_context
from visitor import Visitor, write_lab_files
from waiting import eventually, wait_in

from carts_core.model.camera import HALF_PIXEL
from carts_core.recording import Sequence
from carts_viewer.actions import intents
from carts_viewer.start.site import Site
from carts_viewer.wizard.wizard import RecordingWizard

AXE = os.environ.get("CARTS_AXE")
pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(AXE is None, reason="CARTS_AXE is not set; see this file's docstring"),
]
_FOUND = """() => axe.run(document, { resultTypes: ["violations"] }).then(({ violations }) => violations
    .filter(({ impact }) => ["serious", "critical"].includes(impact))
    .map(({ id, nodes }) => [id, nodes.map(({ html }) => html.slice(0, 200))]))"""


def check(page: Page, name: str) -> None:
    """Assert that axe finds nothing serious or critical in either theme."""
    page.evaluate(Path(AXE or "").read_text(encoding="utf-8"))
    for theme in ("light", "dark"):
        page.evaluate("light => document.documentElement.classList.toggle('carts-light', light)", theme == "light")
        assert page.evaluate(_FOUND) == [], f"{name}, {theme} theme"


def test_each_page_from_the_start_to_the_clicked_points(
    tiny_sequence: Callable[..., Path], tmp_path: Path, browser: Browser
) -> None:
    made = Sequence.open(tiny_sequence(frames=4, cameras=("left",), width=320, height=240))
    assert made.truth is not None
    root = tmp_path / "labs"
    shutil.copytree(made.path.parent / "regular" / "left", root / "day 3" / "left")
    left = made.scene.cameras[0]
    K = left.K.copy()
    K[:2, 2] -= HALF_PIXEL
    write_lab_files(root / "day 3", range(1, 5), made.truth["PSM1"], [("left", (left.width, left.height), K)])
    with Site([root], port=0) as site, closing(new_context(browser)) as context:
        visitor = Visitor(site, context.new_page())
        page = visitor.page
        visitor.button("New recording").wait_for(timeout=60_000)
        check(page, "start page")
        visitor.press("New recording")
        visitor.press_folder("day 3")
        check(page, "file browser")
        visitor.press("Choose this folder")
        visitor.button("Continue to hand-eye").wait_for(timeout=60_000)
        check(page, "Check")
        visitor.press("Continue to hand-eye")
        visitor.reads("Click the tip")
        dismiss_warning(page)
        wizard = site.shown
        assert isinstance(wizard, RecordingWizard)
        for count in range(1, 5):
            prompt = wizard.prompt
            assert prompt is not None
            names, frames = (prompt.landmark,), [prompt.frame]
            (point,) = clicked(made.scene, {"PSM1": made.truth["PSM1"]}, frames, ["left"], noise=0.0, names=names)
            visitor.point_at(point.pixel, (left.width, left.height))
            page.locator(".clicks tr").nth(count).wait_for()
        check(page, "Hand-eye")
        # A mark is moved by the keyboard, and Escape leaves the file browser.
        page.get_by_role("button", name="tip", exact=True).first.click()
        page.locator(".mark[aria-label^='wrist ']").wait_for()  # This frame is shown; the one before has a tip only.
        mark, row = page.locator(".mark[aria-label^='tip ']"), 0
        before = wizard.draft.points[row].pixel
        mark.focus()
        page.keyboard.press("ArrowRight")
        eventually(lambda: wizard.draft.points[row].pixel[0] > before[0])
        page.keyboard.press("Delete")
        eventually(lambda: len(wizard.draft.points) == 3)
        visitor.press("Check")
        visitor.press("Other table …")
        page.locator(".files").wait_for()
        page.keyboard.press("Escape")
        page.locator(".files").wait_for(state="detached")


def test_the_viewer_with_each_tab_and_sheet(open_tab: OpenTab) -> None:
    tab = open_tab(window=(1280, 800), width=160, height=120)
    page = tab.page
    tab.put(intents.Perturb(2.0, 0), intents.Assess(), intents.Download(1))
    page.evaluate(Path(AXE or "").read_text(encoding="utf-8"))
    for scheme in ("dark", "light"):
        wait_in(page, f"document.documentElement.dataset.mantineColorScheme === '{scheme}'")
        for name in ("Optimize", "Review", "Values", "Jobs", "Live", "Export"):
            tab.open(name)
            eventually(lambda: page.evaluate(_FOUND), lambda found: found == [])
        for opened, sheet in (("Frames", "Frames"), ("Keys", "Keys")):
            page.get_by_role("button", name=opened, exact=True).click()
            expect(page.get_by_role("dialog", name=sheet)).to_be_visible()
            assert page.evaluate(_FOUND) == [], f"{sheet}, {scheme} theme"
            tab.press("Escape")
            expect(page.get_by_role("dialog", name=sheet)).to_be_hidden()
        page.get_by_role("button", name="Light or dark").click()
