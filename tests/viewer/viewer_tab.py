"""One tab of the viewer in a real browser."""

from dataclasses import dataclass
from typing import Any

from playwright.sync_api import Page
from viewer_canvas import Canvas
from waiting import wait_in

from carts_viewer.app import ViewerApp
from carts_viewer.state import ViewState
from carts_viewer.tabs import Tab as Place


@dataclass
class Tab:
    """One tab of the viewer."""

    app: ViewerApp
    page: Page
    canvas: Canvas

    @property
    def place_in_viewer(self) -> Place:
        """What the viewer keeps of this tab."""
        return self.place_in(self.app)

    def place_in(self, app: ViewerApp) -> Place:
        """What another viewer at the same address keeps of it."""
        key = self.page.evaluate("carts.key")
        return next(place for place in app.tabs if place.key == key)

    @property
    def state(self) -> ViewState:
        """What this tab shows, as the viewer has it."""
        return self.place_in_viewer.controller.state

    def find(self, label: str) -> Any:
        """This tab's widget with this label."""
        view = self.place_in_viewer.view
        assert view is not None
        return view.page.find(label)

    def slider(self, arm: str, joint: int) -> Any:
        """This tab's slider of a joint."""
        view = self.place_in_viewer.view
        assert view is not None
        return view.layout.joints.slider(arm, joint)

    def button(self, name: str) -> None:
        # Controls of one panel share a sender that keeps the newest message of 50 ms, so a hasty click could be lost.
        self.page.wait_for_timeout(80)
        self.page.get_by_role("button", name=name, exact=True).click()

    def choose(self, label: str, option: str) -> None:
        """Choose from a list, as a person does."""
        self.page.wait_for_timeout(80)
        self.page.locator(f"[id='{self.app.page.element_id(self.find(label))}']").click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def type_value(self, handle: object, value: float) -> None:
        """Type into the number field beside a slider, as a person does."""
        field = self.page.locator(f"[id='{self.app.page.element_id(handle)}'] + * input")
        field.click()
        field.press("Control+a")
        field.press_sequentially(f"{value:g}", delay=60)
        field.press("Tab")

    def place(self, u: float, v: float) -> tuple[float, float]:
        """Where a place of the image [px] is in the window, as the page's own script says."""
        shown, camera = self.page.evaluate("carts.imageOnScreen()"), self.app.scene.camera(self.state.camera)
        box = self.page.locator("canvas").first.bounding_box()
        assert shown is not None and box is not None
        x = box["x"] + shown["left"] + u / camera.width * shown["width"]
        return x, box["y"] + shown["top"] + v / camera.height * shown["height"]

    def wait_until_ready(self) -> None:
        """Wait for the first picture, and take away viser's warning that this browser has no graphics card."""
        wait_in(self.page, "window.carts && window.__viserMutable?.nodeRefFromName['/overlay']")
        self.page.locator(".mantine-Notification-closeButton").click(timeout=30_000)
