"""A tab of the viewer in a real browser: its controls, its picture, and the mouse over the picture."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import Browser, BrowserContext, FloatRect, Locator, Page, expect
from playwright.sync_api import TimeoutError as PageTimeoutError
from waiting import PATIENCE, eventually, wait_in

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.layers import ARM_COLORS
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import Tool
from carts_viewer.state import ViewState
from carts_viewer.tabs import Tab as Place
from carts_viewer.tabs import View
from tools.raw_tab import RawTab

MARKERS = ((0.30, 0.30), (0.70, 0.30), (0.30, 0.70), (0.70, 0.70))
"""Centres of the red discs in a marked frame, as shares of its width and height."""
RADIUS = 0.03
"""Radius of a disc, as a share of the width."""
READY = (
    "window.carts && window.__viserMutable?.nodeRefFromName['/overlay'] && "
    "document.documentElement.style.getPropertyValue('--carts-strip')"
)
"""True in a page that shows its first picture, above a timeline that has its full height."""


_SLOW_DISPLAY = """(() => {
  const next = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (draw) => setTimeout(() => next(draw), 50);
  window.cancelAnimationFrame = clearTimeout;
})()"""


def new_context(browser: Browser, window: tuple[int, int] = (1100, 720), **options: Any) -> BrowserContext:
    """A profile without history. Drawing in software takes a core at full rate, so it draws at most 20 times a second.

    Args:
        window: size of its windows [px].
        options: of Playwright's context.
    """
    context = browser.new_context(viewport={"width": window[0], "height": window[1]}, **options)
    context.set_default_timeout(1000 * PATIENCE)
    context.add_init_script(_SLOW_DISPLAY)
    return context


def decoded(content: bytes, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    """The picture in a file's content."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    assert image is not None
    return image


def mark_frames(folder: Path) -> None:
    """Overwrite the left camera's images of a tiny sequence by red discs on black."""
    for path in (folder / "regular" / "left").iterdir():
        height, width = decoded(path.read_bytes()).shape[:2]
        y, x = np.mgrid[:height, :width] + 0.5
        image = np.zeros((height, width, 3), np.uint8)
        for u, v in MARKERS:
            image[np.hypot(x - u * width, y - v * height) < RADIUS * width] = (0, 0, 255)
        cv2.imwrite(str(path), image)


def run_without_end(app: ViewerApp) -> None:
    """Have the next runs go on until they are stopped, with short iterations.

    The default solver converges on a tiny frame within seconds, whatever the other settings are.
    """
    for name, value in {"solver": "acs", "iterations": 10_000, "working_width": 96}.items():
        app.queue.put(intents.SetSetting(name, value))
    state = app.wait_until_shown()
    assert state.solver == "acs" and state.settings_error is None, state.settings_error


def place_of(app: ViewerApp, raw: RawTab) -> Place:
    """The server's side of a tab without a browser."""
    return next(place for place in app.tabs if place.key == raw.key)


def view_of(app: ViewerApp, raw: RawTab) -> View:
    """Widgets and scene of a tab without a browser."""
    view = place_of(app, raw).view
    assert view is not None
    return view


def widget(app: ViewerApp, raw: RawTab, label: str) -> Any:
    """The widget with this label in a tab without a browser."""
    return view_of(app, raw).page.find(label)


def dismiss_warning(page: Page) -> None:
    """Close viser's warning that this browser has no graphics card; until it is gone, it lies above the sliders."""
    page.locator(".mantine-Notification-closeButton").first.dispatch_event("click")
    page.locator(".mantine-Notification-root").first.wait_for(state="detached")


def press(locator: Locator, timeout: float | None = None) -> None:
    """Click an element once it is at rest, also where it moves before the button of a mouse would be let go.

    The trial takes longer than the 50 ms within which viser sends only the newest press of a panel. An element that is
    not there within `timeout` [ms] raises an error.
    """
    locator.click(trial=True, timeout=timeout)
    click = "one => one.dispatchEvent(new MouseEvent('click', {bubbles: true, cancelable: true, detail: 1}))"
    locator.evaluate(click, timeout=timeout)


def box_of(locator: Locator) -> FloatRect:
    """Where an element is on the screen [px], once it is shown."""
    box = eventually(locator.first.bounding_box, lambda now: now is not None)
    assert box is not None
    return box


@dataclass
class Tab:
    """One tab of the viewer."""

    app: ViewerApp
    page: Page

    def __post_init__(self) -> None:
        self.canvas = Canvas(self)
        self.press = self.page.keyboard.press

    @property
    def place_in_viewer(self) -> Place:
        """The server's side of this tab."""
        return self.place_in(self.app)

    def place_in(self, app: ViewerApp) -> Place:
        """The same in another viewer at the same address."""
        key = self.page.evaluate("carts.key")
        return next(place for place in app.tabs if place.key == key)

    @property
    def state(self) -> ViewState:
        """State of this tab."""
        return self.place_in_viewer.controller.state

    @property
    def view(self) -> View:
        """Widgets and scene of this tab."""
        view = self.place_in_viewer.view
        assert view is not None
        return view

    def put(self, *asked: intents.Intent) -> None:
        """Have the worker do something in this tab, and wait until it is shown."""
        place = self.place_in_viewer
        for intent in asked:
            place.put(intent)
        self.app.wait_until_shown()

    def find(self, label: str) -> Any:
        """The widget with this label."""
        return self.view.page.find(label)

    def slider(self, arm: str, joint: int) -> Any:
        """The slider of a joint."""
        return self.view.layout.joints.slider(arm, joint)

    def element(self, handle: object) -> str:
        """Selector of a widget."""
        return f"[id='{self.app.page.element_id(handle)}']"

    def field(self, slider: object) -> Locator:
        """The number field beside a slider."""
        return self.page.locator(f"{self.element(slider)} + * input")

    def open(self, *names: str) -> None:
        """Choose tabs of the panels, or open folders in them."""
        for name in names:
            tab = self.page.get_by_role("tab", name=name, exact=True)
            if not tab.count():
                press(self.page.get_by_text(name, exact=True).first)
            elif tab.get_attribute("aria-selected") != "true":
                tab.click()
                expect(tab).to_have_attribute("aria-selected", "true")

    def button(self, name: str) -> None:
        """Press a button."""
        press(self.page.get_by_role("button", name=name, exact=True))

    def choose(self, label: str, option: str) -> None:
        """Choose from a list; open it again if an update of the page closed it."""
        field = self.page.locator(self.element(self.find(label)))
        listed = self.page.get_by_role("option", name=option, exact=True)

        def chosen() -> bool:
            field.focus()
            press(field)
            try:
                press(listed, timeout=5000)
                expect(field).to_have_value(option, timeout=5000)
            except (PageTimeoutError, AssertionError):
                field.press("Escape")
                field.blur()
                return False
            return True

        eventually(chosen)

    def type_value(self, handle: Any, value: float, leave: str = "Tab") -> None:
        """Type into the number field beside a slider, and leave it with a key.

        An update of the page between the selection of the old text and the typing adds to the old text: type again.
        """
        field = self.field(handle)

        def shows(shown: float) -> bool:
            return abs(float(field.input_value() or "nan") - shown) < 0.01

        def typed() -> bool:
            field.fill(f"{value:g}")
            return shows(value)

        self.app.wait_until_shown()
        eventually(lambda: shows(handle.value))
        eventually(typed)
        field.press(leave)

    def place(self, u: float, v: float, camera: int = 0) -> tuple[float, float]:
        """Position in the window of a point of the image [px], according to the page's own script."""
        wait_in(self.page, f"carts.imageOnScreen({camera})")
        shown, size = self.page.evaluate(f"carts.imageOnScreen({camera})"), self.app.scene.cameras[camera]
        box = box_of(self.page.locator("canvas"))
        x = box["x"] + shown["left"] + u / size.width * shown["width"]
        return x, box["y"] + shown["top"] + v / size.height * shown["height"]

    def drag(self, *points: tuple[float, float], button: Any = "left", steps: int = 1) -> None:
        """Press at the first point of the window, move to the others, and let go."""
        self.page.mouse.move(*points[0])
        self.page.mouse.down(button=button)
        for point in points[1:]:
            self.page.mouse.move(*point, steps=steps)
        self.page.mouse.up(button=button)

    def wait_until_ready(self) -> None:
        """Wait for the first picture."""
        wait_in(self.page, READY)
        dismiss_warning(self.page)


class Canvas:
    """The picture in a tab."""

    def __init__(self, tab: Tab) -> None:
        self._tab, self._page = tab, tab.page
        self._renderer = OverlayRenderer(tab.app.sequence)

    def screenshot(self) -> np.ndarray:
        """RGB [height, width, 3] of the canvas, tool bar and timeline blanked."""
        box = box_of(self._page.locator("canvas"))
        png = self._page.screenshot(clip={"x": box["x"], "y": box["y"], "width": box["width"], "height": box["height"]})
        image = decoded(png, cv2.IMREAD_COLOR)[..., ::-1].copy()
        top, bottom = self._hidden()
        image[:top], image[image.shape[0] - bottom :] = 0, 0
        return image

    def _hidden(self) -> tuple[int, int]:
        """Heights of the image that the tool bar and the timeline cover [px]."""
        bar, box = (box_of(self._page.locator(name)) for name in (".carts-bar", "canvas"))
        strip = self._page.locator(".carts-strip").first.bounding_box()
        return int(bar["y"] + bar["height"] - box["y"]) + 1, 1 if strip is None else int(strip["height"]) + 1

    def screen_from_image(self, image: np.ndarray) -> np.ndarray | None:
        """The affine map [2, 3] from image to canvas coordinates that the red discs show; None when they do not."""
        red = (image[..., 0] > 120) & (image[..., 1] < 90) & (image[..., 2] < 90)
        _, _, stats, centroids = cv2.connectedComponentsWithStats(red.astype(np.uint8))
        order = np.argsort(-stats[1:, cv2.CC_STAT_AREA])[:4] + 1
        if len(order) < 4:
            return None
        camera = self._tab.app.scene.camera(self._tab.state.camera)
        wanted = np.c_[np.array(MARKERS) * (camera.width, camera.height), np.ones(4)]
        by_row = sorted((centroids[order] + 0.5).tolist(), key=lambda point: point[1])
        found = np.array([*sorted(by_row[:2]), *sorted(by_row[2:])])
        map_, *_ = np.linalg.lstsq(wanted, found, rcond=None)
        return map_.T if np.abs(wanted @ map_ - found).max() < 0.5 else None

    def misregistration(self) -> float:
        """95th percentile of the distance of the overlay's outline from its expected position [px of the screen]."""
        image = self.screenshot()
        map_ = self.screen_from_image(image)
        if map_ is None:
            return float("inf")
        shown = np.linalg.norm(image.astype(float) - ARM_COLORS[0], axis=-1) < 60
        state = self._tab.state
        wanted = _warped(self._renderer.arm_ids(state.pose.scene, state.camera) >= 0, map_, image.shape[:2])
        top, bottom = self._hidden()
        wanted[:top], wanted[wanted.shape[0] - bottom :] = False, False
        if not shown.any() or not wanted.any():
            return float("inf")
        return max(_outline_distance(shown, wanted), _outline_distance(wanted, shown))

    def where(self, good: Callable[[np.ndarray], bool] = lambda map_: True) -> np.ndarray:
        """The map from image to canvas coordinates by the page's script, once the frame is seen there, at a good place.

        What is seen of the red discs alone is no measure of a pixel: the overlay may hide a part of them.
        """

        def at_rest() -> np.ndarray | None:
            seen, place = self.screen_from_image(self.screenshot()), self._page.evaluate("carts.imageOnScreen()")
            if seen is None or place is None:
                return None
            camera = self._tab.app.scene.camera(self._tab.state.camera)
            across, down = place["width"] / camera.width, place["height"] / camera.height
            map_ = np.array([[across, 0.0, place["left"]], [0.0, down, place["top"]]])
            corners = [[0.0, camera.width], [0.0, camera.height], [1.0, 1.0]]
            return map_ if np.abs((map_ - seen) @ corners).max() < 1.5 else None

        map_ = eventually(at_rest, lambda map_: map_ is not None and good(map_))
        assert map_ is not None
        return map_

    def wait_until_registered(self, limit: float = 1.5) -> None:
        """Wait until the overlay is at its expected position, within a distance [px of the screen]."""
        eventually(self.misregistration, lambda distance: distance <= limit)


def _warped(mask: np.ndarray, map_: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image's mask on the screen. OpenCV counts from pixel centres, the map from pixel corners."""
    shifted = map_.copy()
    shifted[:, 2] += map_[:, :2] @ (0.5, 0.5) - 0.5
    smooth = cv2.warpAffine(mask.astype(np.float32), shifted, size[::-1], flags=cv2.INTER_LINEAR)
    return smooth > 0.5


def _outline_distance(mask: np.ndarray, other: np.ndarray) -> float:
    """95th percentile of the distance from the outline of one mask to that of the other [px]."""

    def outline(values: np.ndarray) -> np.ndarray:
        return cv2.morphologyEx(values.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0

    distance = cv2.distanceTransform((~outline(other)).astype(np.uint8), cv2.DIST_L2, 5)
    return float(np.percentile(distance[outline(mask)], 95))


class Hand:
    """The mouse over a marked picture, in pixels of the image."""

    def __init__(self, tab: Tab) -> None:
        self._tab, self.map = tab, tab.canvas.where()
        box = box_of(tab.page.locator("canvas"))
        self._corner = np.array([box["x"], box["y"]])

    def at(self, u: float, v: float) -> tuple[float, float]:
        """Position in the window."""
        x, y = self._corner + self.map @ [u, v, 1.0]
        return float(x), float(y)

    def draw(self, *points: tuple[float, float], button: Any = "left") -> None:
        """Press at the first point, move to the others, and let go."""
        self._tab.drag(*(self.at(*point) for point in points), button=button)

    def take(self, key: str, tool: Tool) -> None:
        """Take a tool by its key, and wait until this tab has it."""
        self._tab.press(key)
        self.holds(tool=tool.lower())

    def holds(self, **wanted: Any) -> None:
        """Wait until this tab has a tool with these properties."""
        eventually(lambda: self._tab.page.evaluate("carts.brush()"), lambda brush: brush | wanted == brush)

    def steps(self, count: int) -> None:
        """Wait until the project has a number of steps in effect, and all strokes are visible in the overlay."""
        eventually(lambda: self._tab.app.state.project.position, lambda position: position == count)
        eventually(lambda: self._tab.page.evaluate("carts.pendingStrokes()"), lambda pending: pending == 0)


OpenViewer = Callable[..., ViewerApp]
"""Type of the fixture `open_viewer`."""
OpenTab = Callable[..., Tab]
"""Type of the fixture `open_tab`."""
