"""The palette of tools and the keys of the page, in headless Chromium."""

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from viewer_tab import Hand, OpenTab, Tab, box_of
from waiting import eventually, wait_in

from carts_core.project import Key
from carts_viewer.actions import intents
from carts_viewer.picture.overlay import OverlayRenderer
from carts_viewer.picture.strokes import Target, Tool

pytestmark = pytest.mark.browser
PHONE = (390, 844)


def _tool(page: Page, name: str, on: bool = True) -> None:
    """Wait until a button of the palette is pressed, or not."""
    button = page.get_by_role("toolbar", name="Tools").get_by_role("button", name=name, exact=True)
    expect(button).to_have_attribute("aria-pressed", str(on).lower())


def _cursor(page: Page) -> str:
    """The cursor over the middle of the image."""
    return page.evaluate("""() => {
        const [on, box] = [carts.imageOnScreen(), __viserMutable.canvas.getBoundingClientRect()];
        const at = document.elementFromPoint(box.left + on.left + on.width / 2, box.top + on.top + on.height / 2);
        return getComputedStyle(at).cursor;
    }""")


def check_tools_move_the_arm(tab: Tab) -> None:
    """The tools drag links and place keypoints without a key held, and pan with the right button."""
    app, page, hand = tab.app, tab.page, Hand(tab)
    tab.put(intents.ShowFrame(0))
    rows, columns = np.nonzero(OverlayRenderer(app.sequence).mask(tab.state.pose.scene, "left"))
    middle = len(rows) // 2
    link = float(columns[middle]), float(rows[middle])
    tab.button("Drag link")
    _tool(page, "Drag link")
    assert _cursor(page) == "grab"
    hand.draw(link, (link[0] + 6, link[1] + 8))
    eventually(lambda: app.project.state.position, lambda count: count == 1)
    assert "Drag" in app.project.state.steps[0].name
    tab.button("Keypoint")
    page.get_by_role("combobox", name="Keypoint", exact=True).select_option(index=1)
    eventually(lambda: tab.state.keypoints.chosen)
    assert "url(" in _cursor(page)
    hand.draw((150.0, 110.0))
    eventually(lambda: len(tab.state.keypoints.pins), lambda count: count == 1)
    expect(page.locator(".carts-options output")).to_contain_text("1 placed · RMS")
    page.get_by_role("group", name="Options: keypoint").get_by_role("button", name="Clear").click()
    eventually(lambda: tab.state.keypoints.pins, lambda pins: not pins)
    before = page.evaluate("carts.imageOnScreen().left")
    page.evaluate("carts.zoomAt(2, 0.5, 0.5)")
    hand.draw((150.0, 110.0), (170.0, 110.0), button="right")
    eventually(lambda: page.evaluate("carts.imageOnScreen().left") != before)
    assert app.project.state.position == 2
    page.evaluate("carts.showEndoscope()")


def check_palette(tab: Tab) -> None:
    """The palette has one stop of the Tab key, and lies beside the image; a reload keeps the tool."""
    page = tab.page
    tab.press("Escape")
    _tool(page, "Select")
    palette, image = box_of(page.get_by_role("toolbar", name="Tools")), page.evaluate("carts.imageOnScreen()")
    assert palette["x"] + palette["width"] <= box_of(page.locator("canvas"))["x"] + image["left"]
    assert page.locator(".carts-tools [tabindex='0']").count() == 1
    page.locator(".carts-tools [tabindex='0']").focus()
    for key, name in (("End", "Loupe"), ("ArrowDown", "Select"), ("ArrowUp", "Loupe"), ("Home", "Select")):
        tab.press(key)
        expect(page.get_by_role("button", name=name, exact=True)).to_be_focused()
    for _ in range(3):
        tab.press("ArrowDown")
    tab.press("Space")
    eventually(lambda: tab.state.brush.tool, lambda tool: tool is Tool.BRUSH)
    assert not tab.state.playing and tab.state.index == 0
    size = page.get_by_role("slider", name="Size [px]", exact=True)
    size.focus()
    tab.press("ArrowRight")
    eventually(lambda: tab.state.brush.diameter, lambda size: size == 21)
    assert tab.state.index == 0
    tab.button("Brush")  # hides its options
    expect(size).to_be_hidden()
    tab.button("Ignore")
    eventually(lambda: tab.state.brush.target, lambda target: target is Target.IGNORE)
    page.reload()
    tab.wait_until_ready()
    _tool(page, "Brush")
    _tool(page, "Ignore")
    tab.press("Escape")
    _tool(page, "Select")
    _tool(page, "Brush", on=False)
    tab.button("Ignore")
    _tool(page, "Ignore", on=False)


def test_the_palette_selects_tools_that_do_what_they_show(open_tab: OpenTab) -> None:
    tab = open_tab(marked=True, frames=3)
    check_palette(tab)
    check_tools_move_the_arm(tab)
    # From any tool, Ignore paints the region to ignore.
    tab.button("Ignore")
    _tool(tab.page, "Brush")
    Hand(tab).draw((30.0, 120.0), (90.0, 120.0))
    eventually(lambda: tab.app.project.state.get(Key.ignore_region(0, "left")))


def test_keys_are_changed_refused_listed_and_remembered(open_tab: OpenTab) -> None:
    tab = open_tab(frames=5, width=160, height=120)
    page = tab.page
    for key, index in (("ArrowRight", 1), ("End", 4), ("ArrowLeft", 3), ("Home", 0)):
        tab.press(key)
        eventually(lambda: tab.state.index, lambda now, index=index: now == index)
    for name, key, answer in (
        ("Next frame: N", "g", "G is the key of “Accept, and show the next unreviewed frame”. Choose another key."),
        ("Next frame: N", "w", "W moves the camera of the 3D view. Choose another key."),
        ("Next frame: N", "Shift+W", "Shift+W: Next frame"),
    ):
        tab.press("?")
        page.get_by_role("button", name=f"{name}. Change the key").click()
        tab.press(key)
        expect(page.locator(".carts-keys output")).to_have_text(answer)
        tab.press("Escape")
        expect(page.get_by_role("dialog", name="Keys")).to_be_hidden()
    eventually(lambda: tab.state.keys, lambda keys: keys == {"MoveFrame 1": "Shift+W"})
    wait_in(page, "carts.keyOf('MoveFrame 1') === 'Shift+W'")
    tab.press("n")
    tab.press("Shift+W")
    eventually(lambda: tab.state.index, lambda index: index == 1)
    # The list of keys, the hints and the list of actions name the new key, also in a tab of a new session.
    other = page.context.new_page()
    other.goto(tab.app.url)
    wait_in(other, "window.carts?.keyOf('MoveFrame 1') === 'Shift+W'")
    other.close()
    assert tab.find("Next frame").hint == "Next frame (Shift+W)"
    tab.press("?")
    expect(page.locator(".carts-keys tr").filter(has_text="Next frame").first).to_contain_text("Shift+W")
    tab.press("Escape")
    tab.press("Control+k")
    # Letters typed before the field is there are keys of the page; a space would start playback.
    expect(page.get_by_placeholder("Search commands...")).to_be_focused()
    page.keyboard.type("next frame")
    expect(page.get_by_role("dialog").get_by_text("Shift+W").first).to_be_visible()
    tab.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    tab.press("?")
    page.locator(".carts-keys [data-do=reset]").click()
    wait_in(page, "carts.keyOf('MoveFrame 1') === 'N'")
    assert not tab.state.keys
    tab.press("Escape")
    tab.press("n")
    eventually(lambda: tab.state.index, lambda index: index == 2)


def test_a_held_key_repeats_motion_but_nothing_that_needs_a_look(open_tab: OpenTab) -> None:
    tab = open_tab(frames=6, masks=False, width=160, height=120)
    for key in "gn":
        for _ in range(3):  # All but the first are repeats.
            tab.page.keyboard.down(key)
        tab.page.keyboard.up(key)
    # One frame is accepted, which shows the next one; three more follow.
    eventually(lambda: tab.state.index, lambda index: index == 4)
    assert [tab.app.project.state.review(frame).state for frame in range(2)] == ["accepted", "untouched"]


def test_escape_closes_what_was_opened_last(open_tab: OpenTab) -> None:
    tab = open_tab(width=160, height=120)
    page = tab.page
    settings, guide = (page.get_by_role("tab", name=name, exact=True) for name in ("Solver settings", "Guide"))
    tab.press("Shift+B")
    _tool(page, "Brush")
    tab.button("Advanced settings")
    expect(settings).to_be_visible()
    page.evaluate("carts.report('Pressed', { key: 'guide' })")
    expect(guide).to_be_visible()
    tab.press("Escape")
    expect(guide).to_be_hidden()
    expect(settings).to_be_visible()
    tab.press("Escape")
    expect(settings).to_be_hidden()
    _tool(page, "Brush")
    tab.press("Escape")
    _tool(page, "Select")


def test_on_a_phone_the_palette_lies_between_the_image_and_the_review_bar(open_tab: OpenTab) -> None:
    tab = open_tab(window=PHONE, width=160, height=120)
    page = tab.page
    bars = page.locator(".carts-strip"), page.locator(".carts-review-bar")
    tab.press("Shift+B")
    _tool(page, "Brush")

    def apart() -> bool:
        image, tools = page.evaluate("carts.imageOnScreen()"), box_of(page.get_by_role("toolbar", name="Tools"))
        options = box_of(page.get_by_role("group", name="Options: brush"))
        below = all(tools["y"] + tools["height"] <= box_of(bar)["y"] for bar in bars)
        beside = tools["x"] >= 0 and tools["x"] + tools["width"] <= PHONE[0]
        return below and beside and image["top"] + image["height"] <= options["y"] <= tools["y"]

    eventually(apart)
    for button in page.get_by_role("toolbar", name="Tools").get_by_role("button").all():
        assert box_of(button)["height"] >= 44 and box_of(button)["width"] >= 38
