"""Controls of the page in headless Chromium: legible, within the window, explained, and usable by keys."""

import math

import pytest
from cut_off import cut_off, hardly_legible
from playwright.sync_api import Page, expect
from viewer_tab import OpenTab, Tab, box_of
from waiting import eventually, wait_in

from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.actions.shortcuts import keys_of
from carts_viewer.panels.help import HINTS, hint_with_keys, set_hints

pytestmark = pytest.mark.browser

TABS = ("Optimize", "Review", "Values", "Jobs", "Live", "Export")
FOLDERS = {"Optimize": ("Free parameters",), "Review": ("Find", "Import")}
"""What is folded at first, by the tab that it lies in."""
PHONE = (390, 844)


def look_into_tabs(tab: Tab, *, folders: bool) -> None:
    """Open every tab of the panels, and see that no text is cut off or hardly legible."""
    for name in TABS:
        tab.page.get_by_role("tab", name=name, exact=True).click()
        for folder in FOLDERS.get(name, ()) if folders else ():
            tab.page.get_by_text(folder, exact=True).click()
        eventually(lambda: [*cut_off(tab.page), *hardly_legible(tab.page)], lambda found: not found)


def go_through_the_tour(page: Page, window: tuple[int, int]) -> list[str]:
    """Titles of the cards, each of which lies in the window beside something that is in view."""
    card, frame, titles = page.get_by_role("dialog", name="Tour"), page.locator(".carts-tour-frame"), []
    while card.count():
        titles.append(card.locator("b").inner_text())
        for box, least in ((box_of(card), 0), (box_of(frame), 10)):
            assert box["x"] >= 0 and box["y"] >= 0 and box["height"] > least, titles
            assert box["x"] + box["width"] <= window[0] and box["y"] + box["height"] <= window[1], titles
        card.locator("[data-do=next]").click()
    return titles


def check_note(tab: Tab) -> None:
    """A note covers neither the names of the images nor the pressed control."""
    tab.put(intents.Download(1))
    note = tab.page.get_by_role("alert").filter(has_text="Nothing has been exported yet")
    expect(note).to_be_visible()
    box, others = box_of(note), tab.page.locator(".carts-cell-label, .carts-review-bar button, .carts-strip canvas")
    assert others.count() >= 3
    for other in others.all():
        at = other.bounding_box()
        apart = at is None or at["y"] + at["height"] <= box["y"] or at["y"] >= box["y"] + box["height"]
        assert apart, other.text_content()
    tab.press("Escape")
    expect(note).to_be_hidden()
    eventually(lambda: tab.state.error, lambda error: error is None)


def check_tour(tab: Tab) -> None:
    """The tour is offered until it is answered, and can be left at any time."""
    page, stored = tab.page, "localStorage.getItem('carts-tour')"
    offer, card = page.locator(".carts-offer"), page.get_by_role("dialog", name="Tour")
    expect(offer).to_be_visible()
    assert page.evaluate(stored) is None
    page.get_by_role("button", name="No tour").click()
    page.evaluate("carts.offerTour()")
    expect(offer).to_have_count(0)
    assert page.evaluate(stored) == "declined"
    page.evaluate("localStorage.removeItem('carts-tour'); carts.offerTour()")
    scrolled = "[...document.querySelectorAll('.mantine-ScrollArea-viewport')].map((one) => one.scrollTop)"
    before = page.evaluate(scrolled)
    page.get_by_role("button", name="Take the tour").click()
    titles = go_through_the_tour(page, (1280, 800))
    assert len(set(titles)) == 10 and titles[0] == "The picture" and page.evaluate(stored) == "begun"
    assert page.evaluate(scrolled) == before
    tab.press("?")
    page.get_by_role("button", name="Take the tour").click()
    tab.press("ArrowRight")
    expect(card).to_contain_text("The verdict")
    tab.press("Escape")
    expect(card).to_have_count(0)
    expect(page.locator(".carts-tour-frame")).to_have_count(0)


def test_every_text_of_a_desktop_page_is_whole_legible_and_explained(open_tab: OpenTab) -> None:
    cameras, domains = ("left", "right"), ("regular", "smoke")
    tab = open_tab(window=(1280, 800), new=True, cameras=cameras, domains=domains, width=160, height=120)
    page = tab.page
    check_tour(tab)
    check_note(tab)
    tab.put(intents.Perturb(2.0, 0), intents.SetRange((0, 1)), intents.Export("csv", "All"))
    for scheme in ("dark", "light"):
        expect(page.locator(f"html[data-mantine-color-scheme={scheme}]")).to_have_count(1)
        look_into_tabs(tab, folders=scheme == "dark")
        page.get_by_role("button", name="Light or dark").click()
    # The panel's scrollbar lies beside its fields.
    tab.open("Optimize")
    bar = box_of(page.locator(".mantine-ScrollArea-scrollbar[data-orientation=vertical]"))
    redo = box_of(page.get_by_role("button", name="Redo", exact=True))
    assert bar["x"] > redo["x"] + redo["width"]
    # Every control has an explanation: over buttons, also greyed out, labels and fields; of a joint with unit, limits.
    assert len(tab.view.page.widgets()) > 120 and set_hints(tab.view.page, {}) == []
    joint = tab.slider("PSM1", 0)
    assert joint.hint is not None and "[°], limits" in joint.hint
    page.get_by_role("button", name="Pause", exact=True).hover(force=True)
    expect(page.get_by_role("button", name="Pause", exact=True)).to_have_attribute(
        "title", hint_with_keys(HINTS["Pause"], keys_of({}))
    )
    expect(page.locator(f"label[for='{tab.app.page.element_id(joint)}']")).to_have_attribute("title", joint.hint)
    page.locator(tab.element(joint)).first.hover(force=True)
    expect(page.get_by_role("tooltip").filter(has_text=joint.hint)).to_be_visible()
    page.mouse.move(640, 5)
    bare = "button:not([title]):not([aria-label]), select:not([title])"
    for bar in (".carts-bar", ".carts-tools", ".carts-strip"):
        assert page.locator(bar).locator(bare).count() == 0
    # A picture that is zoomed keeps its name and fit in view, below the tool bar.
    page.evaluate("carts.zoomAt(4, 0.5, 0.25)")
    canvas, tools = (box_of(page.locator(name)) for name in ("canvas", ".carts-bar"))
    label = page.locator(".carts-marks [data-camera=left] .carts-cell-label")

    def in_view() -> bool:
        box = label.bounding_box()
        return box is not None and box["x"] >= canvas["x"] and box["y"] >= tools["y"] + tools["height"] - 1

    eventually(in_view)


_SHOW_CLOSE_POINTS = """() => {
    const points = [['psm1 jaw 1 tip', 0.4, 0.4], ['psm1 jaw 2 tip', 0.48, 0.43], ['psm1 wrist yaw joint', 0.44, 0.46]];
    const cameras = carts.shown().cameras.map((one, index) => ({ ...one, points: index ? [] : points }));
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


def test_a_phone_shows_what_reading_and_reviewing_needs_and_the_rest_in_a_sheet(open_tab: OpenTab) -> None:
    tab = open_tab(window=PHONE, cameras=("left", "right"), width=160, height=120)
    page, app = tab.page, tab.app
    check_note(tab)
    expect(page.locator(".carts-tools")).to_be_visible()
    page.evaluate("carts.startTour()")
    assert len(go_through_the_tour(page, PHONE)) == 5
    place = page.evaluate("carts.imageOnScreen()")
    assert place["left"] >= 0 and place["left"] + place["width"] <= 391
    for button in page.locator(".carts-review-bar button").all():
        box = box_of(button)
        assert box["x"] >= 0 and box["x"] + box["width"] <= 391 and box["height"] >= 44
    # Keypoints that are close to one another do not lie over each other's names.
    page.evaluate(_SHOW_CLOSE_POINTS)
    expect(page.locator(".carts-point")).to_have_count(3)
    assert page.evaluate(_NAMES_UNDER_RINGS) == []
    page.locator(".carts-review-bar").get_by_role("button", name="Accept", exact=True).click()
    eventually(lambda: app.state.project.review(0).state, lambda state: state == "accepted")
    expect(page.locator(".carts-review-line")).to_contain_text("Frame 002")
    # All panels are one sheet below the picture, which makes room for it.
    assert page.get_by_role("button", name="Undo", exact=True).is_hidden()
    page.get_by_role("button", name="All controls").click()
    expect(page.get_by_role("button", name="Undo", exact=True)).to_be_visible()
    expect(page.get_by_role("tab", name="Optimize", exact=True)).to_be_visible()

    def image_above_sheet() -> bool:
        sheet, canvas = (
            box_of(one) for one in (page.get_by_role("tab", name="Review", exact=True), page.locator("canvas"))
        )
        image = page.evaluate("carts.imageOnScreen()")
        return canvas["y"] + image["top"] + image["height"] < sheet["y"] < PHONE[1] / 2

    eventually(image_above_sheet)
    tab.put(intents.Perturb(2.0, 0), intents.SetRange((0, 1)), intents.Export("csv", "All"))
    look_into_tabs(tab, folders=True)
    # The curves of a run leave the panel as wide as it is.
    tab.open("Optimize")
    tab.put(intents.Step())
    page.locator(".uplot").first.wait_for(state="visible")
    eventually(lambda: cut_off(page), lambda cut: not cut)


def test_a_narrow_window_has_room_for_the_image(open_tab: OpenTab) -> None:
    """The left panel starts collapsed, and the view bar lies within the picture."""
    tab = open_tab(window=(700, 800))

    def within() -> bool:
        bar, canvas = (box_of(tab.page.locator(name)) for name in (".carts-bar", "canvas"))
        return (
            canvas["x"] <= bar["x"]
            and bar["x"] + bar["width"] <= canvas["x"] + canvas["width"]
            and canvas["width"] > 300
        )

    eventually(within)


def check_keys(tab: Tab) -> None:
    """Keys have the functions that the sheet lists."""
    app, page = tab.app, tab.page
    tab.press("?")
    expect(page.get_by_role("dialog", name="Keys")).to_contain_text("Accept, and show the next")
    rows = page.locator(".carts-sheet tr").filter(has_text="Overlay: ").all_inner_texts()
    tab.press("Escape")
    assert [row.split()[0] for row in rows] == list("1234567890")
    for key, _, *name in (row.split() for row in rows):
        tab.press(key)
        eventually(lambda: str(tab.state.layer).lower(), lambda layer, name=name: layer == " ".join(name))
        expect(page.locator(tab.element(tab.find("Layer")))).to_have_value(tab.state.layer)
    for key, check in (
        ("n", lambda: app.state.index == 1),
        ("b", lambda: app.state.index == 0),
        ("p", lambda: app.state.undoable == 1),
        ("Control+z", lambda: app.state.undoable == 0),
        ("Control+Shift+z", lambda: app.state.undoable == 1),
        ("c", lambda: app.state.error is not None),
        ("o", lambda: app.state.undoable == 2),
        ("Shift+i", lambda: app.state.undoable == 3),
        ("g", lambda: app.state.index == 1),
        ("b", lambda: app.state.index == 0 and app.state.review.state == "accepted"),
        ("3", lambda: app.state.layer == "Contour"),
        ("t", lambda: len(app.state.run.curves.loss) == 2),
        ("v", lambda: not page.evaluate("carts.view.endoscope")),
        ("v", lambda: page.evaluate("carts.view.endoscope")),
    ):
        tab.press(key)
        eventually(check)


def check_slider(tab: Tab) -> None:
    app, page, slider = tab.app, tab.page, tab.slider("PSM1", 0)
    # A slider's ends are near the joint of the shown frame; they reach as far as the joint goes, and come back.
    assert slider.max - slider.min <= 12
    tab.put(intents.ShowFrame(11))
    assert slider.max - slider.min <= 12 and slider.min <= slider.value <= slider.max
    typed = round(slider.value - 15.0, 2)
    tab.type_value(slider, typed)
    eventually(lambda: (slider.min, slider.max, slider.value), lambda now: now[0] <= now[2] and now[1] - now[0] > 18)
    assert slider.value == pytest.approx(typed, abs=0.01)
    # Beyond the joint's limits, the limit is shown.
    tab.type_value(slider, -1000.0)
    limit = math.degrees(app.scene.arms[0].robot.joint_limits[0][0])
    expect(tab.field(slider)).to_have_value(f"{limit:.2f}".rstrip("0").rstrip("."))
    tab.field(slider).focus()
    expect(tab.field(slider)).to_have_css("outline-style", "solid")
    tab.button("Back to measured")
    eventually(lambda: slider.max - slider.min, lambda wide: wide <= 12)
    track = page.locator(f"{tab.element(slider)} [role=slider]")
    for name, end in (("aria-valuemin", slider.min), ("aria-valuemax", slider.max)):
        expect(track).to_have_attribute(name, f"{end:g}")


def test_keys_fields_lists_and_errors_leave_the_page_usable_and_no_other_host_is_asked(open_tab: OpenTab) -> None:
    asked: list[str] = []
    tab = open_tab(asked=asked, frames=12, domains=("regular", "smoke"), width=160, height=120, masks=False)
    check_keys(tab)
    app, page = tab.app, tab.page
    tab.put(intents.DismissError(), intents.GoToStep(0), intents.ShowFrame(0))
    check_slider(tab)
    # Keys go on working after a list was used, and after a field was left with a key.
    tab.choose("Domain", "Smoke")
    eventually(lambda: app.state.domain, lambda domain: domain == "smoke")
    lists = "[...document.querySelectorAll('[role=listbox]')].some((one) => one.getClientRects().length)"
    wait_in(page, f"document.activeElement === document.body && !{lists}")
    tab.press("b")
    eventually(lambda: app.state.index, lambda index: index == 10)
    for frame, key in ((5, "Enter"), (7, "Escape")):
        tab.type_value(tab.find("Frame"), frame, leave=key)
        eventually(lambda: app.state.index, lambda index, frame=frame: index == frame - 1)
        wait_in(page, "document.activeElement === document.body")
        tab.press("g")
        eventually(
            lambda frame=frame: app.state.project.review(frame - 1).state, lambda state: state is ReviewState.ACCEPTED
        )
    # An error is shown and can be dismissed; one of a setting is right below its field, and goes with a reset.
    (app.sequence.path.parent / "regular" / "left" / "012.png").unlink()  # Too far away to be read in advance.
    app.sequence.forget_images()
    tab.put(intents.ShowDomain("regular"))
    tab.type_value(tab.find("Frame"), 12)
    message = page.locator(".carts-error[role=alert]")
    expect(message).to_contain_text("012.png")
    expect(page.get_by_text("012.png")).to_have_count(1)
    tab.button("Dismiss")
    expect(message).to_be_hidden()
    tab.button("Advanced settings")
    field = page.get_by_label("Noise", exact=True).first
    tab.put(intents.SetSetting("noise", -5.0))
    error = page.locator(".carts-error").filter(has_text="noise is -5")
    expect(error).to_be_visible()
    above, below = box_of(field), box_of(error)
    assert 0 <= below["y"] - above["y"] - above["height"] < 40
    tab.button("Reset to preset")
    expect(error).to_be_hidden()
    tab.button("Close")
    assert asked and all(url.startswith((app.url, "data:", "blob:")) for url in asked)
