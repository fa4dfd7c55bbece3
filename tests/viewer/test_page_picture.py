"""The picture in headless Chromium, with real pixels: views, the overlay's place, and edits by mouse in the picture."""

import itertools
import math
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, expect
from viewer_tab import MARKERS, Hand, OpenTab, OpenViewer, Tab, box_of, decoded, new_context
from waiting import eventually, wait_in

from carts_core.model.keypoints import project_keypoints
from carts_viewer.actions import intents
from carts_viewer.picture.layers import Layer
from carts_viewer.picture.overlay import OverlayRenderer

pytestmark = pytest.mark.browser

_LINKS_IN_3D = """() => {
    const { nodeRefFromName: nodes, camera, canvas } = window.__viserMutable;
    const depth = nodes['/frame'].position.z;
    const inverse = nodes[''].matrixWorld.clone().invert();
    const places = [];
    for (const [name, node] of Object.entries(nodes)) {
        if (!/^\\/world\\/\\d+\\/[^/]+$/.test(name) || !node) continue;
        const at = camera.position.clone().setFromMatrixPosition(node.matrixWorld);
        if (at.clone().applyMatrix4(inverse).length() > 14 * depth) continue;
        at.project(camera);
        places.push([(at.x + 1) / 2 * canvas.clientWidth, (1 - at.y) / 2 * canvas.clientHeight]);
    }
    return places;
}"""
"""Positions on the canvas [px] of the links near the image."""


_COUNT = """() => {
  const mutable = window.__viserMutable, send = mutable.sendMessage;
  window.sent = [];
  mutable.sendMessage = (message) => { window.sent.push(JSON.stringify(message)); send(message); };
}"""


_PRESS_SHORTLY = """() => { for (const kind of ['keydown', 'keyup']) {
  document.body.dispatchEvent(new KeyboardEvent(kind, { key: ',', bubbles: true }));
} }"""
"""The key of the loupe, for a time that no machine makes long."""


def _loupe(tab: Tab) -> dict[str, Any] | None:
    return tab.page.evaluate("(() => { const b = document.querySelector('.carts-loupe');"
                             " return b && !b.hidden ? { ...b.dataset } : null; })()")  # fmt: skip


def check_loupe(tab: Tab) -> None:
    """The loupe shows position and colour of the pixel under the pointer, and asks the server for no picture."""
    tab.page.evaluate(_COUNT)
    u, v = MARKERS[1][0] * 320, MARKERS[1][1] * 240
    tab.page.mouse.move(*tab.place(u, v))
    # While the key is held, it is shown; pressed shortly, it stays, and follows the pointer.
    tab.page.keyboard.down(",")
    eventually(lambda: _loupe(tab))
    tab.page.evaluate("new Promise((done) => setTimeout(done, 450))")
    tab.page.keyboard.up(",")
    eventually(lambda: _loupe(tab), lambda loupe: loupe is None)
    tab.page.evaluate(_PRESS_SHORTLY)
    loupe = eventually(lambda: _loupe(tab))
    assert loupe is not None and loupe["camera"] == "left"
    assert (float(loupe["u"]), float(loupe["v"])) == pytest.approx((u, v), abs=0.5)
    # The frame is sent as JPEG, so a colour is off by some levels.
    assert np.abs(np.array(loupe["rgb"].split(), float) - (255, 0, 0)).max() < 30
    shown = decoded(tab.page.locator(".carts-loupe canvas").screenshot())[..., 2::-1]
    assert np.abs(shown[65, 65].astype(float) - (255, 0, 0)).max() < 40
    tab.page.mouse.move(*tab.place(160, 12))
    loupe = eventually(lambda: _loupe(tab), lambda loupe: loupe is not None and abs(float(loupe["v"]) - 12) < 0.5)
    assert loupe is not None and max(map(float, loupe["rgb"].split())) < 30
    tab.button("Loupe")
    eventually(lambda: _loupe(tab), lambda loupe: loupe is None)
    # The server knows whether it is shown. That a picture was drawn may be reported at any time.
    sent = [text for text in tab.page.evaluate("window.sent") if "GuiUpdateMessage" in text and "Drawn" not in text]
    assert len(sent) == 2 and all("ShowLoupe" in text for text in sent)


def check_slider(tab: Tab) -> None:
    """A slider's drag ends with the overlay of its last value, and is one step."""
    app, slider = tab.app, tab.slider("PSM1", 0)

    def thumb() -> tuple[float, float]:
        box = box_of(tab.page.locator(f"{tab.element(slider)} [role=slider]"))
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    x, y = thumb()
    tab.drag((x, y), *((x + 12 * math.sin(step / 5), y) for step in range(30)), (x - 10, y))
    eventually(lambda: (app.state.undoable, app.state.unsaved), lambda now: now == (1, False))
    tab.canvas.wait_until_registered()
    final = math.degrees(float(app.state.pose.scene.joint_positions[0][0]))
    assert final == pytest.approx(slider.value, abs=0.06) and final < slider.max - 5.5
    x, y = thumb()
    tab.drag((x, y), (x + 15, y), (x + 18, y))
    eventually(lambda: (app.state.undoable, app.state.unsaved), lambda now: now == (2, False))


def _tip_in_3d(tab: Tab) -> bool:
    """Whether the tip of the first arm is at its current pose in the 3D view."""
    arm, pose = tab.app.scene.arms[0], tab.state.pose.scene
    T_world_tip = pose.T_world_base[0] @ arm.robot.forward_kinematics(pose.joint_positions[0])[-1]
    node = f"window.__viserMutable.nodeRefFromName['/world/0/{arm.robot.link_names[-1]}']"
    return np.allclose(tab.page.evaluate(f"{node}.position.toArray()"), T_world_tip[:3, 3], atol=1e-6)


def check_3d_view(tab: Tab) -> None:
    """The 3D view shows the whole arms at their current poses, with grid, axes and the measured arms."""
    tab.put(intents.Perturb(6.0, 0))
    assert not _tip_in_3d(tab)
    tab.press("v")
    wait_in(tab.page, "!carts.view.endoscope")
    eventually(lambda: _tip_in_3d(tab))
    tab.put(intents.Perturb(3.0, 1))
    eventually(lambda: _tip_in_3d(tab))
    tab.put(intents.Undo())
    eventually(lambda: _tip_in_3d(tab))
    strip, canvas = (box_of(tab.page.locator(name)) for name in (".carts-strip", "canvas"))

    def seen_whole() -> bool:
        places = tab.page.evaluate(_LINKS_IN_3D)
        bottom = strip["y"] - canvas["y"]
        return len(places) >= 3 and all(0 < x < canvas["width"] and 40 < y < bottom for x, y in places)

    eventually(seen_whole)
    # Fit brings them back from anywhere.
    x, y = canvas["x"], canvas["y"] + 300

    def moved_away() -> bool:
        # The camera may still be on its way, and would go on over a drag.
        tab.drag((x + 560, y), (x + 40, y), button="right", steps=6)
        return not seen_whole()

    eventually(moved_away)
    tab.page.get_by_role("button", name="Fit", exact=True).click()
    eventually(seen_whole)
    # Grid and measured arms are seen: the picture changes once the camera has stopped moving.
    pictures = [tab.canvas.screenshot().astype(int)]

    def at_rest() -> bool:
        pictures.append(tab.canvas.screenshot().astype(int))
        return np.array_equal(pictures[-2], pictures[-1])

    for name in ("Grid", "Measured"):
        eventually(at_rest)
        before = pictures[-1]
        tab.page.get_by_role("button", name=name, exact=True).click()
        eventually(
            lambda before=before: (np.abs(before - tab.canvas.screenshot()).max(axis=-1) > 12).sum(),
            lambda count: count > 150,
        )
    axes = "Object.keys(window.__viserMutable.nodeRefFromName).filter(name => name.endsWith('/axes')).length"
    assert tab.page.evaluate(axes) == 2
    tab.press("v")
    wait_in(tab.page, "carts.imageOnScreen() !== null")
    tab.put(intents.Undo())


def test_the_overlay_stays_on_the_frame_in_any_window_zoom_and_view(open_tab: OpenTab) -> None:
    tab = open_tab(window=(1700, 620), marked=True)
    canvas, mouse = tab.canvas, tab.page.mouse
    canvas.wait_until_registered()
    check_loupe(tab)
    tab.page.set_viewport_size({"width": 1280, "height": 800})
    wait_in(tab.page, "Math.abs(__viserMutable.canvas.getBoundingClientRect().bottom - innerHeight) < 2")
    canvas.wait_until_registered()
    # The wheel zooms about the pointer.
    before, box = canvas.where(), box_of(tab.page.locator("canvas"))
    mouse.move(640, 400)
    mouse.wheel(0, -400)
    after = canvas.where(lambda map_: map_[0, 0] > 1.7 * before[0, 0])
    pointer = np.array([640 - box["x"], 400 - box["y"]])
    image = np.linalg.solve(before[:, :2], pointer - before[:, 2])
    assert after @ [*image, 1.0] == pytest.approx(pointer, abs=2.0)
    tab.drag((640, 400), (670, 415))
    dragged = canvas.where(lambda map_: abs(map_[0, 2] - after[0, 2]) > 25)
    assert dragged[:, 2] - after[:, 2] == pytest.approx([30, 15], abs=2.0)
    canvas.wait_until_registered()
    check_3d_view(tab)
    canvas.wait_until_registered()
    # In the endoscope view, a drag does not rotate the camera.
    tab.drag((640, 400), (740, 440), steps=5)
    canvas.wait_until_registered()


def test_sliders_keypoints_and_links_are_dragged_and_each_drag_is_one_step(open_tab: OpenTab) -> None:
    tab = open_tab(window=(1150, 720), marked=True)
    app, mouse, keyboard = tab.app, tab.page.mouse, tab.page.keyboard
    check_slider(tab)
    tab.put(intents.Undo(), intents.Undo())
    hand = Hand(tab)
    keyboard.down("Shift")
    mouse.click(*hand.at(150.0, 110.0))
    (pin,) = eventually(lambda: app.state.keypoints.pins, lambda pins: len(pins) == 1)
    eventually(lambda: not app.state.unsaved)
    assert app.state.undoable == 1, "the slider was undone"
    # A screen pixel is less than half an image pixel here.
    assert pin.pixel == pytest.approx((150.0, 110.0), abs=1.0) and app.state.keypoints.residuals[0] < 1.0
    keyboard.up("Shift")
    # A field that has the focus loses it to the drag, which does not end the drag, nor does a rest on the way.
    tab.field(tab.find("Frame")).click()
    keyboard.down("Shift")
    mouse.move(*hand.at(150.0, 110.0))
    mouse.down()
    mouse.move(*hand.at(154.0, 112.0))
    eventually(lambda: app.state.unsaved)
    wait_in(tab.page, "document.activeElement === document.body")
    app.wait_until_shown()
    mouse.move(*hand.at(164.0, 117.0))
    eventually(lambda: app.state.keypoints.pins[-1].pixel, lambda at: at == pytest.approx((164.0, 117.0), abs=1.0))
    assert app.state.unsaved and app.state.undoable == 2
    mouse.up()
    keyboard.up("Shift")
    eventually(lambda: app.state, lambda state: state.undoable == 2 and not state.unsaved)
    # A link follows the pointer with the button down, and the picture stays in place.
    renderer = OverlayRenderer(app.sequence)
    rows, columns = np.nonzero(renderer.arm_ids(app.state.pose.scene, "left") == 0)
    middle = int(np.median(np.arange(len(rows))))
    place = columns[middle] + 0.5, rows[middle] + 0.5
    point = renderer.pick(app.state.pose.scene, "left", place, 0.0)
    assert point is not None

    def seen() -> np.ndarray:
        return np.array(project_keypoints(app.scene, app.state.pose.scene, [point], "left")[0].tolist())

    before, drawn = seen(), tab.page.evaluate("carts.drawnOverlay()")
    keyboard.down("Control")
    mouse.move(*hand.at(*place))
    mouse.down()
    mouse.move(*hand.at(place[0] + 6.0, place[1] + 4.0))
    eventually(lambda: tab.page.evaluate("carts.drawnOverlay()"), lambda now: now != drawn)
    mouse.move(*hand.at(place[0] + 12.0, place[1] + 8.0))
    eventually(seen, lambda at: at - before == pytest.approx([12.0, 8.0], abs=1.5))
    mouse.up()
    keyboard.up("Control")
    eventually(lambda: app.project.state.position, lambda position: position == 3)
    assert tab.canvas.where() == pytest.approx(hand.map, abs=0.5)
    tab.press("Control+z")
    eventually(seen, lambda at: at == pytest.approx(before, abs=0.05))


def test_two_cameras_lie_beside_each_other_and_a_click_chooses_one(open_tab: OpenTab) -> None:
    tab = open_tab(cameras=("left", "right"), width=160, height=120)
    app = tab.app
    wait_in(tab.page, "carts.shown().cameras.length == 2 && carts.imageOnScreen(1)")
    left, right = (tab.page.evaluate(f"carts.imageOnScreen({index})") for index in (0, 1))
    apart = abs(left["left"] - right["left"]) >= left["width"] or abs(left["top"] - right["top"]) >= left["height"]
    assert apart and left["width"] == pytest.approx(right["width"], abs=1.0)
    # The fit of both is in view, whichever is chosen, and a run is about both.
    for camera in ("left", "right"):
        expect(tab.page.locator(f".carts-marks [data-camera={camera}] text").first).to_contain_text("Dice")
    assert app.state.every_camera
    # A keypoint can be placed in either; a plain click chooses the camera that is painted on.
    tab.page.keyboard.down("Shift")
    tab.page.mouse.click(*tab.place(80, 48, camera=1))
    tab.page.keyboard.up("Shift")
    (pin,) = eventually(lambda: app.state.keypoints.pins, lambda pins: len(pins) == 1)
    assert pin.camera == "right" and pin.pixel == pytest.approx((80.0, 48.0), abs=1.0)
    tab.page.mouse.click(*tab.place(32, 24, camera=1))
    eventually(lambda: app.state.camera, lambda camera: camera == "right")
    # Rings have names, are open, fade near the pointer, and do not grow with the zoom.
    expect(tab.page.locator(".carts-point text").first).not_to_be_empty()
    ring = tab.page.locator(".carts-point circle").first
    eventually(lambda: ring.evaluate("one => getComputedStyle(one).fill"), lambda fill: fill == "none")
    wait_in(tab.page, "carts.imageOnScreen(1)")  # The two images change places.
    width = "document.querySelector('.carts-point circle').getBoundingClientRect().width"
    before, shown = tab.page.evaluate(width), tab.page.evaluate("carts.imageOnScreen(1).width")

    def near() -> int:
        # The two images may still be changing places.
        box = box_of(ring)
        tab.page.mouse.move(box["x"] + 9, box["y"] + 9)
        return tab.page.locator(".carts-point.near").count()

    eventually(near)
    tab.page.evaluate("carts.zoomAt(4, 0.5, 0.5)")
    wait_in(tab.page, f"carts.imageOnScreen(1)?.width > {3 * shown}")
    assert tab.page.evaluate(width) == pytest.approx(before, abs=0.5)


_SLOW_LOADING = """(() => {
  const { get, set } = Object.getOwnPropertyDescriptor(HTMLImageElement.prototype, 'src');
  Object.defineProperty(HTMLImageElement.prototype, 'src', {
    get,
    set(address) { setTimeout(() => set.call(this, address), String(address).startsWith('blob:') ? 400 : 0); },
  });
})()"""
_NOTE_EXPECTED = """() => {
  const { expectPicture } = carts;
  window.expected = [];
  carts.expectPicture = (...picture) => { window.expected.push(picture); expectPicture(...picture); };
}"""
_DRAWN = """window.sent.filter((text) => text.includes('Drawn'))
  .map((text) => JSON.parse(JSON.parse(text).updates.value)[2].picture)"""


def test_a_page_that_loads_pictures_slowly_shows_some_of_them_during_playback(
    browser: Browser, open_viewer: OpenViewer
) -> None:
    app = open_viewer(frames=3, marked=True)
    with closing(new_context(browser)) as context:
        context.add_init_script("localStorage.setItem('carts-tour', 'seen')")
        context.add_init_script(_SLOW_LOADING)
        tab = Tab(app, context.new_page())
        tab.page.goto(app.url)
        tab.wait_until_ready()
        place, stopped, drawn = tab.place_in_viewer, threading.Event(), set()

        def play() -> None:
            for step in itertools.count():
                place.put(intents.ShowFrame(step % 3))
                place.put(intents.SetOpacity(0.4 + 0.01 * (step % 50)))
                if stopped.wait(0.02):
                    return

        def seen() -> int:
            drawn.add(tab.page.evaluate("carts.drawnOverlay()"))
            return len(drawn)

        with ThreadPoolExecutor(1) as threads:
            threads.submit(play)
            try:
                eventually(seen, lambda count: count > 2)
            finally:
                stopped.set()
        app.wait_until_shown()
        eventually(lambda: place.view and place.view.display.ready_in() == 0.0)


def test_each_picture_is_acknowledged_also_where_an_image_stays_the_same(open_tab: OpenTab) -> None:
    tab = open_tab(frames=3)
    tab.page.evaluate(_COUNT)
    tab.page.evaluate(_NOTE_EXPECTED)
    # Without an overlay, only the frame changes, and then only the overlay; of no layer, the opacity changes nothing.
    for intent, changed in (
        (intents.ShowLayer(Layer.NONE), ["/overlay"]),
        (intents.ShowFrame(1), ["/frame"]),
        (intents.ShowFrame(2), ["/frame"]),
        (intents.SetOpacity(0.4), []),
        (intents.ShowLayer(Layer.CONTOUR), ["/overlay"]),
        (intents.ShowFrame(0), ["/frame", "/overlay"]),
    ):
        before = tab.page.evaluate("window.expected.length")
        tab.put(intent)
        wait_in(tab.page, f"window.expected.length > {before}")
        number, nodes = tab.page.evaluate("window.expected.at(-1)")
        assert nodes == changed
        wait_in(tab.page, f"{_DRAWN}.includes({number})", 30.0)
