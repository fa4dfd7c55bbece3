"""Several tabs at once, in headless Chromium: everybody their own place in one project, whoever comes or goes."""

import math
import socket
import time
from collections.abc import Callable
from contextlib import closing

import pytest
from playwright.sync_api import Browser, Route, expect
from viewer_canvas import Canvas, eventually
from viewer_run import run_without_end
from viewer_tab import Tab
from waiting import wait_in

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser

EVERYWHERE = ".".join("0000")
WINDOW = (1100, 720)


def _shows_its_own(tab: Tab) -> None:
    """Wait until a tab shows what the viewer has of it: frame, joint, opacity, note, history and the picture itself."""
    app = tab.app
    app.wait_until_shown()
    state, joint = tab.state, tab.slider("PSM1", 0)
    for handle, value in (
        (tab.find("Frame"), state.index + 1),
        (joint, joint.value),
        (tab.find("Opacity %"), round(100 * state.opacity)),
    ):
        field = tab.page.locator(f"[id='{app.page.element_id(handle)}'] + * input")
        expect(field).to_have_value(f"{value:g}", timeout=20_000)
    expect(tab.page.get_by_text(f"({state.index + 1} of {len(app.sequence)})")).to_be_visible(timeout=20_000)
    tab.page.get_by_text("Review", exact=True).first.click()
    expect(tab.page.locator(".mantine-TextInput-input:visible").first).to_have_value(state.review.note)
    history = tab.page.locator(f"[id='{app.page.element_id(tab.find('Go to'))}']")
    expect(history).to_have_value(tab.find("Go to").value)
    assert tab.canvas.eventually_registered() <= 1.5
    tab.page.get_by_text("Optimize", exact=True).first.click()


def _joint(tab: Tab) -> float:
    return math.degrees(float(tab.state.pose.scene.joint_positions[0][0]))


def test_three_tabs_are_at_three_places_and_one_that_reloads_is_where_it_was(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    first, second, third = (open_tab(app, WINDOW) for _ in range(3))
    for tab in (second, third):
        tab.place_in_viewer.put(intents.SetOpacity(1.0))
    first.type_value(first.find("Frame"), 2)
    eventually(lambda: first.state.index, lambda index: index == 1)
    value = round(second.slider("PSM1", 0).value - 3.0, 2)
    second.type_value(second.slider("PSM1", 0), value)
    eventually(lambda: _joint(second), lambda at: abs(at - value) < 1e-3)
    third.type_value(third.find("Opacity %"), 95)
    eventually(lambda: third.state.opacity, lambda opacity: opacity == 0.95)
    # The frame is everybody's own, the project is not.
    assert [tab.state.index for tab in (first, second, third)] == [1, 0, 0]
    assert abs(_joint(third) - value) < 1e-3 and [len(t.state.project.steps) for t in (first, second, third)] == [1] * 3
    for tab in (first, second, third):
        _shows_its_own(tab)
    first.page.reload()
    first.wait_until_ready()
    assert first.state.index == 1 and "frame=2" in first.page.url
    _shows_its_own(first)


def test_a_tab_that_is_closed_in_mid_drag_leaves_a_saved_edit_and_does_not_hold_up_the_others(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    dragged, second = open_tab(app, WINDOW), open_tab(app, WINDOW)
    second.place_in_viewer.put(intents.SetOpacity(1.0))
    place = dragged.place_in_viewer
    start = _joint(dragged)
    box = dragged.page.locator(f"[id='{app.page.element_id(dragged.slider('PSM1', 0))}'] [role=slider]").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    dragged.page.mouse.move(x, y)
    dragged.page.mouse.down()
    for step in range(15):
        dragged.page.mouse.move(x + step, y)
    eventually(lambda: abs(_joint(dragged) - start), lambda moved: moved > 1.0)
    assert place.controller.state.unsaved
    dragged.page.close()
    # Nobody has let go of the slider, so the edit is saved when its time is over.
    eventually(lambda: place.controller.state.unsaved, lambda unsaved: not unsaved)
    eventually(lambda: second.state.undoable, lambda steps: steps == 1)
    _shows_its_own(second)
    value = round(second.slider("PSM1", 0).value - 4.0, 2)
    second.type_value(second.slider("PSM1", 0), value)
    eventually(lambda: second.state.undoable, lambda steps: steps == 2)
    _shows_its_own(second)


def test_undo_and_redo_can_be_pressed_as_soon_as_the_other_tab_has_left(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer()
    first, second = open_tab(app, WINDOW), open_tab(app, WINDOW)
    first.type_value(first.slider("PSM1", 0), round(first.slider("PSM1", 0).value - 3.0, 2))
    eventually(lambda: second.state.undoable, lambda steps: steps == 1)
    undo, redo = (second.page.get_by_role("button", name=name, exact=True) for name in ("Undo", "Redo"))
    expect(undo).to_be_disabled()
    first.page.close()
    expect(undo).to_be_enabled()
    undo.click()
    eventually(lambda: app.project.state.joints(0), lambda joints: not joints)
    expect(redo).to_be_enabled()


def test_one_worker_does_what_three_tabs_ask_for_and_loses_nothing_of_it(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12)
    tabs = [open_tab(app, WINDOW) for _ in range(3)]
    for count, tab in enumerate(tabs, start=1):
        for _ in range(count):
            tab.page.keyboard.press("n")
    eventually(lambda: [tab.state.index for tab in tabs], lambda places: places == [1, 2, 3])
    for tab in tabs:
        tab.page.keyboard.press("o")
    eventually(lambda: app.state.undoable, lambda steps: steps == 3)
    for count, tab in enumerate(tabs, start=2):
        expect(tab.page.get_by_text(f"({count} of 12)")).to_be_visible(timeout=20_000)


def test_a_run_goes_on_while_its_tab_reloads_and_others_work(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer()
    run_without_end(app)
    first, second = open_tab(app, WINDOW), open_tab(app, WINDOW)
    first.button("Run")
    expect(first.page.locator(".carts-status")).to_contain_text("running", timeout=30_000)
    assert second.state.run.phase is Phase.IDLE
    second.page.keyboard.press("n")
    eventually(lambda: second.state.index, lambda index: index == 1)
    second.page.keyboard.press("o")
    eventually(lambda: second.state.undoable, lambda steps: steps >= 1)
    before = len(first.state.run.curves.loss)
    first.page.reload()
    first.wait_until_ready()
    assert first.state.index == 0 and first.state.run.phase is Phase.RUNNING
    eventually(lambda: len(first.state.run.curves.loss), lambda count: count > before)
    first.button("Pause")
    eventually(lambda: first.state.run.phase, lambda phase: phase is Phase.PAUSED)


def test_a_link_opens_its_frame_camera_and_domain_and_takes_nobody_along(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab], browser: Browser
) -> None:
    app = open_viewer(cameras=("left", "right"), domains=("regular", "smoke"))
    first = open_tab(app, WINDOW)
    place = first.place_in_viewer
    for intent in (intents.ShowFrame(2), intents.ShowCamera("right"), intents.ShowDomain("smoke")):
        place.put(intent)
    app.wait_until_shown()
    wait_in(first.page, "location.search.includes('domain=smoke') && location.search.includes('frame=3')")
    link = first.page.url
    first.type_value(first.find("Frame"), 1)
    with closing(browser.new_context()) as context:
        page = context.new_page()
        page.goto(link)
        other = Tab(app, page, Canvas(app, page))
        other.wait_until_ready()
        state = other.state
        assert (state.index, state.camera, state.domain) == (2, "right", "smoke") and page.url == link
        assert first.state.index == 0
        page.goto(link.replace("project=tiny", "project=elsewhere"))
        expect(page.get_by_text("This link is for elsewhere")).to_be_visible(timeout=20_000)


def test_the_history_says_who_did_what_and_undo_takes_back_ones_own(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer()
    ann, bob = open_tab(app, WINDOW), open_tab(app, WINDOW)
    for tab, name in ((ann, "Ann"), (bob, "Bob")):
        tab.page.get_by_text("Review", exact=True).first.click()
        field = tab.page.locator(".mantine-TextInput-input:visible").last
        field.fill(name)
        field.press("Enter")
        eventually(lambda tab=tab: tab.state.name, lambda known, name=name: known == name)
        field.blur()
    bob.page.keyboard.press("n")
    eventually(lambda: bob.state.index, lambda index: index == 1)
    ann.page.keyboard.press("o")
    eventually(lambda: app.state.undoable, lambda steps: steps == 1)
    bob.page.keyboard.press("o")
    eventually(lambda: app.state.undoable, lambda steps: steps == 2)
    names = [step.name for step in app.project.state.steps]
    assert names[0].startswith("Ann: Nudge") and names[1].startswith("Bob: Nudge")
    expect(ann.page.get_by_text("on frame 002")).to_be_visible(timeout=20_000)
    ann.button("Undo")
    eventually(lambda: app.state.undoable, lambda steps: steps == 3)
    assert app.project.state.steps[2].name.startswith("Ann: Undo: Nudge")
    assert not app.project.state.joints(0) and app.project.state.joints(1)
    assert (ann.state.index, bob.state.index) == (0, 1)


def test_the_token_of_the_address_is_used_up_by_the_page_and_reloading_works(
    tiny_sequence: Callable[..., object], untrained_weights: object, browser: Browser
) -> None:
    with ViewerApp.open(tiny_sequence(), host=EVERYWHERE, port=0, weights=(untrained_weights,)) as app:  # type: ignore[arg-type]
        plain = f"http://127.0.0.1:{app.page.server.get_port()}/"
        context, stranger = browser.new_context(), browser.new_context()
        try:
            page = context.new_page()
            page.goto(plain + "?" + app.url.partition("?")[2])
            tab = Tab(app, page, Canvas(app, page))
            tab.wait_until_ready()
            assert (
                page.url.startswith(plain)
                and "token" not in page.url
                and "carts-" not in page.evaluate("document.cookie")
            )
            page.reload()
            tab.wait_until_ready()
            tab.page.keyboard.press("n")
            eventually(lambda: app.state.index, lambda index: index == 1)
            answer = stranger.new_page().goto(plain)
            assert answer is not None and answer.status == 403
        finally:
            context.close()
            stranger.close()


def _call_of_a_link(app: ViewerApp, browser: Browser, timeout: float, *, policy: bool = True) -> float | None:
    """Follow a link that names another server, and wait until the page calls it.

    Args:
        app: Whose page it is.
        browser: Which follows the link.
        timeout: How long to wait when the page is there [s].
        policy: Whether the page comes with the header that says whom it may call.

    Returns:
        The time from the click to the call [s]; None when there is none.
    """
    with closing(browser.new_context()) as context, closing(socket.create_server(("127.0.0.1", 0))) as listener:
        listener.settimeout(timeout)
        link = f"{app.url}/?websocket=ws://127.0.0.1:{listener.getsockname()[1]}"
        page = context.new_page()
        if not policy:
            page.route(link, _without_policy)
        clicked = time.monotonic()
        page.goto(link)
        try:
            listener.accept()[0].close()
        except TimeoutError:
            return None
        return time.monotonic() - clicked


def _without_policy(route: Route) -> None:
    answer = route.fetch()
    headers = {name: value for name, value in answer.headers.items() if name != "content-security-policy"}
    assert len(headers) < len(answer.headers)
    route.fulfill(response=answer, headers=headers)


def test_a_link_cannot_make_the_page_obey_another_server(
    open_viewer: Callable[..., ViewerApp], browser: Browser
) -> None:
    app = open_viewer()
    delay = _call_of_a_link(app, browser, 60.0, policy=False)
    assert delay is not None, "the link does nothing anyway, so this shows nothing"
    assert _call_of_a_link(app, browser, 3.0 + 2.0 * delay) is None
