"""Painting in the page: strokes of a real mouse in headless Chromium, and strokes that no page would send."""

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from test_painting import Discs
from viewer_tab import Hand, OpenTab, OpenViewer, Tab, decoded, place_of, widget
from waiting import eventually

from carts_core.model.parts import part_classes
from carts_core.project import Key
from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.picture.layers import IGNORED_COLOR, Layer, label_color
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import Target, Tool
from tools.raw_tab import RawTab


def _line(*points: tuple[float, float], width: int = 20) -> np.ndarray:
    canvas = np.zeros((240, 320), np.uint8)
    # To 1/16 of a pixel, from pixel centres.
    cv2.polylines(canvas, [np.rint(16 * np.array(points) - 8).astype(np.int32)], False, 1, width, cv2.LINE_8, 4)
    return canvas.astype(bool)


def _same(got: np.ndarray, wanted: np.ndarray) -> bool:
    """Whether two masks agree but for a pixel along their outline."""

    def wider(mask: np.ndarray) -> np.ndarray:
        return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)

    return bool(got.any() and not (got & ~wider(wanted)).any() and not (wanted & ~wider(got)).any())


def _ignored(app: ViewerApp) -> np.ndarray:
    region = app.project.state.get(Key.ignore_region(0, "left"))
    return np.zeros((240, 320), bool) if region is None else region.region()


def _mask(app: ViewerApp) -> np.ndarray:
    correction = app.project.state.get(Key.mask_correction(0, "left"))
    return OverlayRenderer(app.sequence).mask(app.state.pose.scene, "left", correction)


def _coloured(tab: Tab, color: tuple[int, int, int]) -> int:
    """How many pixels of the picture have a colour."""
    return int((np.linalg.norm(tab.canvas.screenshot().astype(float) - color, axis=-1) < 40).sum())


@pytest.mark.browser
def test_strokes_are_exact_at_any_zoom_seen_in_every_tab_and_taken_back(open_tab: OpenTab) -> None:
    tab = open_tab(marked=True, networks={"segmenter": Discs()})
    app = tab.app
    tab.button("Ignore")
    eventually(lambda: tab.state.brush.target, lambda target: target is Target.IGNORE)
    # The region to ignore needs a brush. Another tab has its own tool in hand, and shows what was painted.
    other = open_tab(app, (960, 640))
    expect(other.page.locator("canvas.carts-paint")).to_have_css("pointer-events", "none")
    other.put(intents.SetOpacity(1.0))
    hand = Hand(tab)
    hand.holds(tool="brush", target="Ignore region")
    points = [(30.0, 120.0), (120.0, 140.0), (200.0, 40.0), (290.0, 60.0)]
    hand.draw(*points)
    hand.steps(1)
    assert _same(_ignored(app), _line(*points))
    for seen in (tab, other):
        eventually(lambda seen=seen: _coloured(seen, IGNORED_COLOR), lambda pixels: pixels > 500)
    # The picture has not moved. With two people, taking it back is a step, too.
    assert tab.canvas.where() == pytest.approx(hand.map, abs=0.5)
    tab.press("Control+z")
    hand.steps(2)
    assert not _ignored(app).any()
    for seen in (tab, other):
        eventually(lambda seen=seen: _coloured(seen, IGNORED_COLOR), lambda pixels: pixels == 0)
    other.page.close()
    # The wheel zooms and the right button moves the picture with a tool in hand.
    before = hand.map
    tab.page.mouse.move(*hand.at(160.0, 120.0))
    tab.page.mouse.wheel(0, -200)
    hand.map = zoomed = tab.canvas.where(lambda map_: map_[0, 0] > 1.2 * before[0, 0])
    hand.draw((160.0, 120.0), (166.0, 116.0), button="right")
    hand.map = tab.canvas.where(lambda map_: abs(map_[0, 2] - zoomed[0, 2]) > 5)
    hand.draw((150.0, 100.0), (180.0, 140.0))
    hand.steps(3)
    assert _same(_ignored(app), _line((150.0, 100.0), (180.0, 140.0)))
    # Strokes in a row are a step each.
    for row in range(4):
        hand.draw((140.0, 70.0 + 10 * row), (190.0, 70.0 + 10 * row))
    hand.steps(7)
    # A click and a box of the tool Prompt.
    hand.take("Shift+T", Tool.PROMPT)
    tab.page.mouse.click(*hand.at(185.0, 150.0))
    hand.steps(8)
    assert _ignored(app)[150, 185]
    tab.press("Enter")
    hand.draw((140.0, 140.0), (150.0, 150.0), (160.0, 155.0))
    hand.steps(9)
    assert _ignored(app)[148, 145]
    # With the tool put away, the left button moves the picture again. What was painted may hide the discs.
    hand.take("Escape", Tool.SELECT)
    left = tab.page.evaluate("carts.imageOnScreen().left")
    hand.draw((160.0, 120.0), (156.0, 124.0))
    eventually(
        lambda: tab.page.evaluate("carts.imageOnScreen()?.left ?? null"),
        lambda now: now is not None and abs(now - left) > 5,
    )
    assert app.state.project.position == 9


@pytest.mark.browser
def test_polygon_eraser_shift_and_classes_change_the_mask_as_exported(open_tab: OpenTab) -> None:
    tab = open_tab(marked=True)
    app, hand = tab.app, Hand(tab)
    rendered = OverlayRenderer(app.sequence).mask(app.state.pose.scene, "left")
    hand.take("Shift+P", Tool.POLYGON)
    corners = [(20.0, 30.0), (140.0, 40.0), (120.0, 200.0), (30.0, 180.0)]
    hand.draw((5.0, 5.0))
    tab.press("Escape")  # A polygon that is dropped leaves nothing, and the tool stays in hand.
    for point in (*corners, (200.0, 100.0)):
        hand.draw(point)
    tab.press("Backspace")
    tab.press("Enter")
    hand.steps(1)
    polygon = np.zeros((240, 320), np.uint8)
    cv2.fillPoly(polygon, [np.rint(16 * np.array(corners) - 8).astype(np.int32)], 1, cv2.LINE_8, 4)
    wanted = rendered | polygon.astype(bool)
    assert _same(_mask(app), wanted)
    hand.take("Shift+X", Tool.ERASER)
    across = [(10.0, 100.0), (310.0, 130.0)]
    hand.draw(*across)
    hand.steps(2)
    wanted &= ~_line(*across)
    # Shift is the opposite: the eraser paints.
    tab.page.keyboard.down("Shift")
    hand.draw((240.0, 60.0), (300.0, 80.0))
    tab.page.keyboard.up("Shift")
    hand.steps(3)
    wanted |= _line((240.0, 60.0), (300.0, 80.0))
    eventually(lambda: _same(_mask(app), wanted), bool)
    tab.open("Export")
    with tab.page.expect_download() as started:
        tab.button("Export mask")
    assert np.array_equal(decoded(started.value.path().read_bytes()) > 0, _mask(app))
    # A class shows the layer of parts with its legend, and is painted in its colour.
    wrist = next(one for one in part_classes(app.scene.arms) if one.part == "wrist")
    tab.page.get_by_label("Class").select_option(wrist.name)
    eventually(lambda: tab.state.layer, lambda layer: layer is Layer.PARTS)
    for one in part_classes(app.scene.arms):
        expect(tab.page.locator(".carts-legend").get_by_text(one.name, exact=True)).to_be_visible()
    hand.take("Shift+B", Tool.BRUSH)
    hand.holds(label=wrist.number)
    before = _coloured(tab, label_color(wrist.number))
    hand.draw((20.0, 60.0), (20.0, 150.0))
    hand.steps(4)
    found = app.project.state.get(Key.part_labels(0, "left"))
    assert found is not None and (found.labels() == wrist.number).sum() > 1500
    eventually(lambda: _coloured(tab, label_color(wrist.number)), lambda count: count > before + 2000)
    tab.press("Control+z")
    eventually(lambda: app.project.state.get(Key.part_labels(0, "left")), lambda layer: layer is None)


def test_strokes_that_no_page_would_send_are_refused_and_disturb_nobody(open_viewer: OpenViewer) -> None:
    app = open_viewer()
    camera = app.scene.cameras[0].name
    good = {"number": 1, "frame": 0, "camera": camera, "target": "Ignore region", "erase": False, "polygon": False}
    good |= {"diameter": 5, "points": [[10, 10], [40, 30]]}
    with RawTab(app.url) as tab, RawTab(app.url) as other:
        for number, changes in enumerate(({"points": [[float("nan"), 1]]}, {"frame": 10**9}, {"camera": "../../x"})):
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
