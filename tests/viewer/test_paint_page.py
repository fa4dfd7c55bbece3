"""Painting in the page: strokes of a real mouse in headless Chromium, and strokes that no page would send."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from places import place_of, widget
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_core.project import Key
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.jobs.optimizers import OptimizerFactory
from carts_viewer.picture.layers import IGNORED_COLOR
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import Tool
from tools.raw_tab import RawTab

Open = Callable[..., ViewerApp]
OpenTab = Callable[..., Tab]


class Hand:
    """A mouse over the picture of a tab, in pixels of the image."""

    def __init__(self, tab: Tab) -> None:
        self._mouse, self._keyboard = tab.page.mouse, tab.page.keyboard
        self._tab = tab
        self.locate()

    def locate(self) -> None:
        """Find out where the picture is."""
        self.map = self._tab.canvas.where()
        box = self._tab.page.locator("canvas").first.bounding_box()
        assert box is not None
        self._corner = box["x"], box["y"]

    def move(self, u: float, v: float) -> None:
        x, y = self.map @ [u, v, 1.0]
        self._mouse.move(self._corner[0] + x, self._corner[1] + y)

    def draw(self, *points: tuple[float, float], button: Any = "left") -> None:
        self.move(*points[0])
        self._mouse.down(button=button)
        for point in points[1:]:
            self.move(*point)
        self._mouse.up(button=button)

    def click(self, *points: tuple[float, float]) -> None:
        for point in points:
            self.draw(point)

    def take(self, key: str, tool: Tool) -> None:
        """Take a tool by its key, and wait until this tab knows."""
        self._keyboard.press(key)
        self.holds(tool=tool.lower())

    def holds(self, **wanted: Any) -> None:
        """Wait until this tab knows what is in hand."""
        eventually(lambda: self._tab.page.evaluate("carts.brush()"), lambda brush: brush | wanted == brush)

    def steps(self, count: int) -> None:
        """Wait until the project has so many steps that are done, and all strokes are seen in the overlay."""
        eventually(lambda: self._tab.app.state.project.position, lambda position: position == count)
        eventually(lambda: self._tab.page.evaluate("carts.pendingStrokes()"), lambda pending: pending == 0)


def _line(shape: tuple[int, int], *points: tuple[float, float], width: int) -> np.ndarray:
    canvas = np.zeros(shape, np.uint8)
    corners = np.rint(np.array(points) - 0.5).astype(np.int32)
    cv2.polylines(canvas, [corners], False, 1, width)
    return canvas.astype(bool)


def _same(got: np.ndarray, wanted: np.ndarray) -> bool:
    """Whether two masks agree but for a pixel along their outline."""

    def wider(mask: np.ndarray) -> np.ndarray:
        return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)

    return bool(got.any() and not (got & ~wider(wanted)).any() and not (wanted & ~wider(got)).any())


def _ignored(app: ViewerApp) -> np.ndarray:
    region = app.project.state.get(_keys(app)[1])
    return np.zeros((240, 320), bool) if region is None else region.region()


def _keys(app: ViewerApp) -> Sequence[Any]:
    return Key.mask_correction(app.state.index, "left"), Key.ignore_region(app.state.index, "left")


@pytest.mark.browser
def test_a_stroke_is_in_the_project_and_in_every_tab_and_undo_takes_it_out(
    open_marked: Open, open_tab: OpenTab
) -> None:
    app = open_marked()
    tab = open_tab(app)
    tab.page.get_by_text("Paint", exact=True).click()
    tab.button("Ignore region")
    tab.button("Brush")
    # Another tab has its own tool in hand, and sees what was painted.
    other = open_tab(app, (1000, 900))
    expect(other.page.locator("canvas.carts-paint")).to_have_css("pointer-events", "none")
    other.place_in_viewer.put(intents.SetOpacity(1.0))
    hand = Hand(tab)
    hand.holds(tool="brush", target="Ignore region")
    points = [(30.0, 120.0), (120.0, 140.0), (200.0, 40.0), (290.0, 60.0)]
    hand.draw(*points)
    hand.steps(1)
    assert _same(_ignored(app), _line((240, 320), *points, width=20))
    for seen in (tab, other):
        eventually(lambda seen=seen: _violet(seen.canvas.screenshot()), lambda pixels: pixels > 500)
    # Neither was the picture moved, nor is anything left of the stroke that the page drew by itself.
    assert tab.canvas.where() == pytest.approx(hand.map, abs=0.5)
    # Nobody is alone, so taking it back is a step, too.
    tab.page.keyboard.press("Control+z")
    hand.steps(2)
    assert not _ignored(app).any()
    for seen in (tab, other):
        eventually(lambda seen=seen: _violet(seen.canvas.screenshot()), lambda pixels: pixels == 0)


def _violet(image: np.ndarray) -> int:
    return int((np.linalg.norm(image.astype(float) - IGNORED_COLOR, axis=-1) < 40).sum())


@pytest.mark.browser
def test_eraser_shift_and_polygon_change_the_mask_as_exported(open_marked: Open, open_tab: OpenTab) -> None:
    app = open_marked()
    tab = open_tab(app)
    hand = Hand(tab)
    rendered = OverlayRenderer(app.sequence).mask(app.state.pose.scene, "left")
    hand.take("Shift+P", Tool.POLYGON)
    corners = [(20.0, 30.0), (140.0, 40.0), (120.0, 200.0), (30.0, 180.0)]
    hand.click((5.0, 5.0))
    tab.page.keyboard.press("Escape")  # A polygon that is dropped leaves nothing, and the tool stays in hand.
    hand.click(*corners, (200.0, 100.0))
    tab.page.keyboard.press("Backspace")
    tab.page.keyboard.press("Enter")
    hand.steps(1)
    polygon = np.zeros((240, 320), np.uint8)
    cv2.fillPoly(polygon, [np.rint(np.array(corners) - 0.5).astype(np.int32)], 1)
    wanted = rendered | polygon.astype(bool)
    assert _same(_mask(app), wanted)
    hand.take("Shift+X", Tool.ERASER)
    across = [(10.0, 100.0), (310.0, 130.0)]
    hand.draw(*across)
    hand.steps(2)
    wanted &= ~_line((240, 320), *across, width=20)
    assert _same(_mask(app), wanted)
    # Shift is the opposite: the eraser paints.
    tab.page.keyboard.down("Shift")
    hand.draw((240.0, 60.0), (300.0, 80.0))
    tab.page.keyboard.up("Shift")
    hand.steps(3)
    wanted |= _line((240, 320), (240.0, 60.0), (300.0, 80.0), width=20)
    assert _same(_mask(app), wanted)
    tab.page.get_by_text("Export", exact=True).click()
    with tab.page.expect_download() as started:
        tab.button("Export mask")
    exported = cv2.imread(str(Path(started.value.path())), cv2.IMREAD_UNCHANGED)
    assert exported is not None and np.array_equal(exported > 0, _mask(app))


def _mask(app: ViewerApp) -> np.ndarray:
    return OverlayRenderer(app.sequence).mask(app.state.pose.scene, "left", app.project.state.get(_keys(app)[0]))


@pytest.mark.browser
def test_with_a_tool_in_hand_the_wheel_zooms_the_right_button_moves_and_strokes_stay_exact(
    open_marked: Open, open_tab: OpenTab
) -> None:
    app = open_marked()
    tab = open_tab(app)
    hand = Hand(tab)
    tab.page.keyboard.press("Shift+M")
    hand.holds(target="Ignore region")
    hand.take("Shift+B", Tool.BRUSH)
    before = hand.map
    hand.move(160.0, 120.0)
    tab.page.mouse.wheel(0, -200)
    hand.map = tab.canvas.where(lambda map_: map_[0, 0] > 1.2 * before[0, 0])
    zoomed = hand.map
    hand.draw((160.0, 120.0), (166.0, 116.0), button="right")
    hand.map = tab.canvas.where(lambda map_: abs(map_[0, 2] - zoomed[0, 2]) > 5)
    hand.draw((150.0, 100.0), (180.0, 140.0))
    hand.steps(1)
    assert _same(_ignored(app), _line((240, 320), (150.0, 100.0), (180.0, 140.0), width=20))
    # With the tool put away, the left button moves the picture again.
    hand.take("Escape", Tool.OFF)
    moved = hand.map
    hand.draw((160.0, 120.0), (150.0, 130.0))
    tab.canvas.where(lambda map_: abs(map_[0, 2] - moved[0, 2]) > 5)
    assert len(app.project.state.steps) == 1


@pytest.mark.slow
@pytest.mark.browser
def test_thirty_strokes_in_a_row_are_thirty_steps(open_marked: Open, open_tab: OpenTab) -> None:
    app = open_marked()
    tab = open_tab(app)
    hand = Hand(tab)
    tab.page.keyboard.press("Shift+M")
    hand.holds(target="Ignore region")
    hand.take("Shift+B", Tool.BRUSH)
    for key in "[[[[[]":
        tab.page.keyboard.press(key)
        tab.page.wait_for_timeout(60)
    width = 8
    hand.holds(diameter=width)
    lines = [((20.0 + 9 * n, 30.0), (25.0 + 9 * n, 210.0)) for n in range(30)]
    for line in lines:
        hand.draw(*line)
    hand.steps(30)
    assert {step.name for step in app.project.state.steps} == {"Ignore pixels, frame 001"}
    wanted = np.logical_or.reduce([_line((240, 320), *line, width=width) for line in lines])
    assert _same(_ignored(app), wanted)


@pytest.mark.browser
def test_a_run_in_the_page_is_given_the_ignore_region(
    open_marked: Open, open_tab: OpenTab, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    make = OptimizerFactory.make

    def watched(self: OptimizerFactory, *arguments: Any) -> Any:
        given.append(arguments[-1].ignore)
        return make(self, *arguments)

    app = open_marked()
    tab = open_tab(app)
    hand = Hand(tab)
    tab.page.keyboard.press("Shift+M")
    hand.holds(target="Ignore region")
    hand.take("Shift+B", Tool.BRUSH)
    hand.draw((100.0, 100.0), (150.0, 150.0))
    hand.steps(1)
    monkeypatch.setattr(OptimizerFactory, "make", watched)
    tab.button("Step")
    eventually(lambda: len(given), bool)
    assert np.array_equal(given[0]["left"], _ignored(app))


def test_strokes_that_no_page_would_send_are_refused_and_disturb_nobody(open_viewer: Open) -> None:
    app = open_viewer()
    camera = app.scene.cameras[0].name
    good = {"number": 1, "frame": 0, "camera": camera, "target": "Ignore region", "erase": False, "polygon": False}
    good |= {"diameter": 5, "points": [[10, 10], [40, 30]]}
    bad = [
        {"points": [[float("nan"), 1]]},
        {"points": [[1, 2]] * 60_000},
        {"diameter": -5},
        {"frame": 10**9},
        {"camera": "../../etc/passwd"},
        {"target": "__class__"},
    ]
    with RawTab(app.url) as tab, RawTab(app.url) as other:
        for number, changes in enumerate(bad):
            tab.report("Painted", **(good | {"number": number} | changes))
        channel = next(i for i, widget in tab.widgets.items() if widget.get("label") == "channel")
        for text in ("", "nonsense", "[" * 100_000, '["tab", 1]', '["tab", 1, {"type": "__class__"}]'):
            tab.set(channel, text)
        tab.report("Pressed", key="__class__")
        for kind in ("Undo", "Run", "Export", "SetJoint"):
            tab.report(kind)
        other.set(app.page.element_id(widget(app, other, "Frame")), 2)
        eventually(lambda: place_of(app, other).controller.state.index, lambda index: index == 1)
        assert not app.wait_until_shown().project.steps and app.state.error is None
        # Far outside is at most one image size outside, and the frame is the one that the stroke names.
        tab.report("Painted", **(good | {"points": [[-1e9, 20], [1e9, 20]]}))
        eventually(lambda: len(app.project.state.steps), lambda count: count == 1)
    app.queue.put(intents.ShowFrame(0))
    region = app.wait_until_shown().ignore_region
    assert region is not None and region.region()[20].all() and not region.region()[30].any()
