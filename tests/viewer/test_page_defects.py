"""What once stood in people's way, in a real browser: one session, several checks."""

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cut_off import hardly_legible
from playwright.sync_api import expect
from viewer_canvas import eventually
from viewer_tab import Tab
from waiting import wait_in

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser


def test_two_cameras_lie_beside_each_other_and_a_click_chooses_one(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(cameras=("left", "right"), width=160, height=120)
    tab = open_tab(app)
    wait_in(tab.page, "carts.shown().cameras.length == 2 && carts.imageOnScreen(1)")
    left, right = (tab.page.evaluate(f"carts.imageOnScreen({index})") for index in (0, 1))
    apart = abs(left["left"] - right["left"]) >= left["width"] or abs(left["top"] - right["top"]) >= left["height"]
    assert apart and left["width"] == pytest.approx(right["width"], abs=1.0)
    # The fit of both is in view, whichever is chosen, and the run is about both.
    expect(tab.page.locator(".carts-marks [data-camera=left] text").first).to_contain_text("Dice")
    expect(tab.page.locator(".carts-marks [data-camera=right] text").first).to_contain_text("Dice")
    assert app.state.every_camera
    box = tab.page.locator("canvas").first.bounding_box()
    assert box is not None

    def on_screen(u: float, v: float) -> tuple[float, float]:
        place = tab.page.evaluate("carts.imageOnScreen(1)")
        return box["x"] + place["left"] + u * place["width"], box["y"] + place["top"] + v * place["height"]

    # A keypoint can be placed in either; a plain click chooses the camera that is painted on.
    tab.page.keyboard.down("Shift")
    tab.page.mouse.click(*on_screen(0.5, 0.4))
    tab.page.keyboard.up("Shift")
    (pin,) = eventually(lambda: app.state.keypoints.pins, lambda pins: len(pins) == 1)
    assert pin.camera == "right" and pin.pixel == pytest.approx((80.0, 48.0), abs=1.0)
    tab.page.mouse.click(*on_screen(0.2, 0.2))
    eventually(lambda: app.state.camera, lambda camera: camera == "right")
    # Rings have names, and do not grow with the zoom.
    expect(tab.page.locator(".carts-point text").first).not_to_be_empty()
    # The image changes places with the other one; the page may be between the two.
    wait_in(tab.page, "carts.imageOnScreen(1)")
    width = "document.querySelector('.carts-point circle').getBoundingClientRect().width"
    before, shown = tab.page.evaluate(width), tab.page.evaluate("carts.imageOnScreen(1).width")
    tab.page.evaluate("carts.zoomAt(4, 0.5, 0.5)")
    wait_in(tab.page, f"carts.imageOnScreen(1)?.width > {3 * shown}")
    assert tab.page.evaluate(width) == pytest.approx(before, abs=0.5)


def test_the_page_says_what_is_so(open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    verdict = tab.page.locator(".carts-verdict")
    expect(verdict).to_contain_text("not checked")
    # Key 5 shows what the optimizer would see, and is no run.
    tab.page.keyboard.press("5")
    eventually(lambda: app.state.maps, lambda maps: maps is not None)
    app.wait_until_shown()
    expect(tab.page.get_by_text("determined by this image")).to_have_count(0)
    tab.button("Run")
    eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and run.reason is not None, timeout=90)
    said = eventually(lambda: app.state.verdict, lambda found: found is not None)
    assert said is not None
    app.wait_until_shown()
    expect(verdict).to_contain_text(f"Mask {said.verdict}")
    expect(verdict).to_contain_text("joints not determined")
    expect(tab.page.get_by_text("Converged")).to_have_count(0)
    # The curve compares every iterate with the same image, is named, and says so when it is out of date.
    assert app.state.run.curves.comparable
    expect(tab.page.locator(".u-legend .u-label").filter(has_text="Loss [1]").first).to_be_visible()
    expect(tab.page.locator(".carts-curve.carts-outdated")).to_have_count(0)
    tab.page.keyboard.press("o")
    expect(tab.page.locator(".carts-curve.carts-outdated").first).to_be_visible()
    expect(verdict).to_contain_text("not checked")
    # Moved by hand is not untouched.
    app.queue.put(intents.ShowFrame(1))
    app.wait_until_shown()
    tab.page.keyboard.press("o")
    tab.page.get_by_text("Review", exact=True).first.click()
    expect(tab.page.get_by_text("2 moved by hand")).to_be_visible()
    # Nothing is saved by a server that does not answer.
    expect(tab.page.locator(".carts-saved span")).to_be_visible()
    app.page.close()
    expect(tab.page.locator("body.carts-offline .carts-saved")).to_be_visible(timeout=10_000)
    style = "getComputedStyle(document.querySelector('.carts-saved'), '::after').content"
    assert "NOT CONNECTED" in tab.page.evaluate(style)
    expect(tab.page.locator(".carts-saved span")).to_be_hidden()


def test_nothing_gets_in_the_way(open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]) -> None:
    app = open_viewer(frames=12, width=160, height=120, domains=("regular", "smoke"))
    tab = open_tab(app, (1280, 800))
    # A slider's ends are those of the frame that is shown.
    slider = app.view.layout.joints.slider("PSM1", 0)
    assert slider.max - slider.min <= 12
    app.queue.put(intents.ShowFrame(11))
    app.wait_until_shown()
    assert slider.max - slider.min <= 12 and slider.min <= slider.value <= slider.max
    # They reach as far as the joint goes, and come back when it does.
    tab.place_in_viewer.put(intents.SetJoint("PSM1", 0, math.radians(slider.value - 15.0)))
    tab.place_in_viewer.put(intents.Released())
    eventually(lambda: (slider.min, slider.max, slider.value), lambda now: now[0] <= now[2] and now[1] - now[0] > 18)
    tab.button("Back to measured")
    eventually(lambda: slider.max - slider.min, lambda wide: wide <= 12)
    track = f"[id='{app.page.element_id(slider)}'] [role=slider]"
    for name, end in (("aria-valuemin", slider.min), ("aria-valuemax", slider.max)):
        expect(tab.page.locator(track)).to_have_attribute(name, f"{end:g}")
    # Keys go on working after a list was used.
    tab.choose("Domain", "Smoke")
    eventually(lambda: app.state.domain, lambda domain: domain == "smoke")
    wait_in(tab.page, "document.activeElement === document.body")
    tab.page.wait_for_timeout(150)
    tab.page.keyboard.press("b")
    eventually(lambda: app.state.index, lambda index: index == 10)
    # Numbers are not cut off.
    cut = tab.page.evaluate(
        "[...document.querySelectorAll('.mantine-Slider-root + .mantine-NumberInput-root input')]"
        ".filter(field => field.offsetParent && field.scrollWidth > field.clientWidth + 1).length"
    )
    assert cut == 0
    # An error is right below its field, and goes with a reset.
    tab.button("Advanced settings")
    field = tab.page.get_by_label("Noise", exact=True).first
    app.queue.put(intents.SetSetting("noise", -5.0))
    error = tab.page.locator(".carts-error").filter(has_text="noise is -5")
    expect(error).to_be_visible()
    above, below = field.bounding_box(), error.bounding_box()
    assert above is not None and below is not None and 0 <= below["y"] - above["y"] - above["height"] < 40
    tab.button("Reset all to the preset")
    expect(error).to_be_hidden()
    tab.button("Close")
    # The timeline takes the whole width, zooms with the wheel and follows the pointer.
    strip = tab.page.locator(".carts-strip canvas")
    box, canvas = strip.bounding_box(), tab.page.locator("canvas").first.bounding_box()
    assert box is not None and canvas is not None and box["width"] == pytest.approx(canvas["width"], abs=2)
    tab.page.mouse.move(box["x"] + 0.04 * box["width"], box["y"] + 20)
    tab.page.mouse.down()
    eventually(lambda: app.state.index, lambda index: index == 0)
    tab.page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20, steps=4)
    tab.page.mouse.up()
    eventually(lambda: app.state.index, lambda index: index == 6)
    tab.page.mouse.wheel(0, -200)
    shown = eventually(lambda: tab.page.evaluate("carts.timeline().view"), lambda view: view[1] - view[0] < 10)
    assert shown[0] < 6 < shown[1]
    # The sheet of keys, and the theme, which stays with the tab.
    tab.page.keyboard.press("?")
    expect(tab.page.get_by_role("dialog", name="Keys")).to_contain_text("Accept, and go to the next")
    tab.page.keyboard.press("Escape")
    tab.page.get_by_role("button", name="Light or dark").click()
    expect(tab.page.locator("html[data-mantine-color-scheme=light]")).to_have_count(1)


_SHOW_CLOSE_POINTS = """() => {
    const points = [['psm1 jaw 1 tip', 0.4, 0.4], ['psm1 jaw 2 tip', 0.48, 0.43], ['psm1 wrist yaw joint', 0.44, 0.46]];
    const cameras = [{ ...carts.shown().cameras[0], points }];
    document.dispatchEvent(new CustomEvent('carts-page', { detail: { ...carts.shown(), cameras } }));
}"""

_NAMES_UNDER_RINGS = """() => {
    const box = (one) => one.getBoundingClientRect();
    const rings = [...document.querySelectorAll('.carts-point circle.edge')].map(box);
    const over = (ring, name) =>
        ring.left < name.right && ring.right > name.left && ring.top < name.bottom - 2 && ring.bottom > name.top + 2;
    const names = [...document.querySelectorAll('.carts-point text')];
    return names.filter((name) => rings.some((ring) => over(ring, box(name)))).map((name) => name.textContent);
}"""


def test_a_phone_shows_what_reading_and_reviewing_needs(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app, (390, 844))
    accept = tab.page.locator(".carts-review-bar").get_by_role("button", name="Accept", exact=True)
    expect(accept).to_be_visible()
    place = tab.page.evaluate("carts.imageOnScreen()")
    assert place["left"] >= 0 and place["left"] + place["width"] <= 391
    for button in tab.page.locator(".carts-review-bar button").all():
        box = button.bounding_box()
        assert box is not None and box["x"] >= 0 and box["x"] + box["width"] <= 391 and box["height"] >= 44
    # The other controls are behind a button, and hide nothing before.
    assert tab.page.get_by_role("button", name="Undo", exact=True).is_hidden()
    tab.page.get_by_role("button", name="All controls").click()
    expect(tab.page.get_by_role("button", name="Undo", exact=True)).to_be_visible()
    tab.page.get_by_role("button", name="All controls").click()
    # Keypoints that are close to one another do not lie over each other's names.
    tab.page.evaluate(_SHOW_CLOSE_POINTS)
    expect(tab.page.locator(".carts-point")).to_have_count(3)
    assert tab.page.evaluate(_NAMES_UNDER_RINGS) == []
    accept.click()
    eventually(lambda: app.state.project.review(0).state, lambda state: state == "accepted")
    expect(tab.page.locator(".carts-review-line")).to_contain_text("Frame 002")


def test_jobs_go_on_while_the_page_is_used_and_a_server_that_comes_back_finds_everybody_where_they_were(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=6, width=160, height=120)
    tab = open_tab(app)
    tab.page.get_by_text("Jobs", exact=True).first.click()
    tab.button("Optimize each alone")
    running = tab.page.locator(".carts-jobs li.running")
    expect(running).to_contain_text("Optimize 6 frames, each alone")
    tab.page.keyboard.press("n")
    eventually(lambda: app.state.index, lambda index: index == 1)
    tab.button("Cancel")
    expect(tab.page.locator(".carts-jobs li.cancelled")).to_be_visible()
    # So is how far sliders reach, and what is drawn over the image, in a server that knows nothing of this tab.
    tab.choose("Slider range", "± 20")
    tab.choose("Layer", "Contour")
    eventually(lambda: (app.state.reach, app.state.layer), lambda now: now == ("± 20", "Contour"))
    wait_in(tab.page, "JSON.parse(localStorage.getItem('carts-settings')).layer == 'Contour'")
    # The same address answers again, by another server: frame and tab are those from before.
    app.queue.put(intents.ShowFrame(4))
    app.wait_until_shown()
    wait_in(tab.page, "carts.shown().frame == 4")
    port = int(app.url.split(":")[2].strip("/").split("/")[0].split("?")[0])
    app.close()
    expect(tab.page.locator("body.carts-offline")).to_be_attached(timeout=10_000)
    with ViewerApp.open(app.sequence.path, port=port) as again:
        again.wait_until_shown(60)
        eventually(lambda: again.state.index, lambda index: index == 4, timeout=60)
        expect(tab.page.locator("[role=tab][aria-selected=true]").filter(has_text="Jobs")).to_be_visible(timeout=20_000)
        expect(tab.page.locator(".carts-jobs li.cancelled")).to_be_visible()
        eventually(lambda: (again.state.reach, again.state.layer), lambda now: now == ("± 20", "Contour"))
        view = tab.place_in(again).view
        assert view is not None
        slider = view.layout.joints.slider("PSM1", 0)
        assert slider.max - slider.min > 30


def test_times_of_ros_are_read_as_dates_and_seconds(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    def as_ros(folder: Path) -> None:
        table = folder / "kinematics.csv"
        rows = list(csv.reader(table.open()))
        place = rows[0].index("time")
        for row in rows[1:]:
            row[place] = f"{1467072000.25 + float(row[place]):.6f}"
        table.write_text("\n".join(map(",".join, rows)) + "\n")

    app = open_viewer(width=160, height=120, prepare=as_ros)
    tab = open_tab(app)
    tab.page.keyboard.press("n")
    caption = tab.page.locator(".carts-caption").filter(has_text="(2 of 3)")
    expect(caption).to_contain_text("0.100 s after the first, 2016-06-28 00:00:00 UTC")
    assert "e+09" not in tab.page.locator("body").inner_text()


def test_clicked_keypoints_stay_when_the_optimizer_runs(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    tab.page.keyboard.press("h")
    tab.page.keyboard.down("Shift")
    tab.page.mouse.click(*tab.place(80, 60))
    tab.page.keyboard.up("Shift")
    expect(tab.page.locator(".carts-pin")).to_have_count(1)
    # What is to be clicked is not hidden: a ring is open, and fades with its name near the pointer.
    ring = tab.page.locator(".carts-point circle").first
    assert ring.evaluate("one => getComputedStyle(one).fill") == "none"
    box = ring.bounding_box()
    assert box is not None
    tab.page.mouse.move(box["x"] + 9, box["y"] + 9)
    expect(tab.page.locator(".carts-point.near")).not_to_have_count(0)
    tab.button("Run")
    eventually(lambda: app.state.run, lambda run: run.phase is Phase.IDLE and run.reason is not None, timeout=90)
    expect(tab.page.locator(".carts-pin")).to_have_count(1)


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


def test_the_3d_view_shows_the_arms_whole_with_grid_axes_and_the_measured_arms(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(width=160, height=120)
    tab = open_tab(app)
    tab.place_in_viewer.put(intents.Perturb(6.0, 0))
    app.wait_until_shown()
    tab.page.keyboard.press("v")
    strip, canvas = (tab.page.locator(name).first.bounding_box() for name in (".carts-strip", "canvas"))
    assert strip is not None and canvas is not None

    def seen_whole() -> bool:
        places = tab.page.evaluate(_LINKS_IN_3D)
        bottom = strip["y"] - canvas["y"]
        return len(places) >= 3 and all(0 < x < canvas["width"] and 40 < y < bottom for x, y in places)

    eventually(seen_whole, bool)
    # Fit brings it back from anywhere.
    tab.page.mouse.move(canvas["x"] + 560, canvas["y"] + 300)
    tab.page.mouse.down(button="right")
    tab.page.mouse.move(canvas["x"] + 40, canvas["y"] + 300, steps=6)
    tab.page.mouse.up(button="right")
    eventually(seen_whole, lambda whole: not whole)
    tab.page.get_by_role("button", name="Fit", exact=True).click()
    eventually(seen_whole, bool)
    tab.page.wait_for_timeout(1200)
    # Grid and measured arms are there, and can be switched off.
    for name in ("Grid", "Measured"):
        before = tab.canvas.screenshot().astype(int)
        tab.page.get_by_role("button", name=name, exact=True).click()
        eventually(
            lambda before=before: (np.abs(before - tab.canvas.screenshot()).max(axis=-1) > 12).sum(),
            lambda count: count > 150,
        )
    axes = "Object.keys(window.__viserMutable.nodeRefFromName).filter(name => name.endsWith('/axes')).length"
    assert tab.page.evaluate(axes) == 2
    tab.page.keyboard.press("v")
    wait_in(tab.page, "carts.imageOnScreen() !== null")


def test_every_text_can_be_read_in_the_light_and_in_the_dark(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(cameras=("left", "right"), width=160, height=120)
    tab = open_tab(app)
    for scheme in ("dark", "light"):
        expect(tab.page.locator(f"html[data-mantine-color-scheme={scheme}]")).to_have_count(1)
        for name in ("Optimize", "Review", "Values", "Jobs", "Live", "Export", "Help"):
            tab.page.get_by_role("tab", name=name, exact=True).click()
            eventually(lambda: hardly_legible(tab.page), lambda found: not found)
        tab.page.get_by_role("button", name="Light or dark").click()
