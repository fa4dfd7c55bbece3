"""Several tabs at once, in headless Chromium: one state, shown by all of them, whoever comes, goes or reloads."""

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

from carts_viewer import intents
from carts_viewer.app import ViewerApp
from carts_viewer.state import Phase

pytestmark = pytest.mark.browser

EVERYWHERE = ".".join("0000")
WINDOW = (1100, 720)


def _agree(tabs: list[Tab]) -> None:
    """Wait until every tab shows the present state: frame, joint, opacity, review, history and the picture itself."""
    app = tabs[0].app
    state = app.wait_until_shown()
    joint = app.joints.slider("PSM1", 0)
    for tab in tabs:
        for handle, value in (
            (app.page.find("Frame"), state.index + 1),
            (joint, joint.value),
            (app.page.find("Opacity %"), round(100 * state.opacity)),
        ):
            field = tab.page.locator(f"[id='{app.page.element_id(handle)}'] + * input")
            expect(field).to_have_value(f"{value:g}", timeout=20_000)
        expect(tab.page.get_by_text(f"({state.index + 1} of {len(app.sequence)})")).to_be_visible(timeout=20_000)
        tab.page.get_by_text("Review", exact=True).first.click()
        expect(tab.page.locator(".mantine-TextInput-input:visible")).to_have_value(state.review.note)
        history = tab.page.locator(f"[id='{app.page.element_id(app.page.find('Go to'))}']")
        expect(history).to_have_value(app.page.find("Go to").value)
        assert tab.canvas.eventually_registered() <= 1.5
        tab.page.get_by_text("Optimize", exact=True).first.click()


def _joint(app: ViewerApp) -> float:
    return math.degrees(float(app.state.pose.scene.joint_positions[0][0]))


def test_three_tabs_show_one_state_and_so_does_one_that_reloads_or_joins(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    tabs = [open_tab(app, WINDOW) for _ in range(3)]
    first, second, third = tabs
    first.type_value(app.page.find("Frame"), 2)
    eventually(lambda: app.state.index, lambda index: index == 1)
    value = round(app.joints.slider("PSM1", 0).value - 3.0, 2)
    second.type_value(app.joints.slider("PSM1", 0), value)
    eventually(lambda: _joint(app), lambda at: abs(at - value) < 1e-3)
    third.type_value(app.page.find("Opacity %"), 95)
    eventually(lambda: app.state.opacity, lambda opacity: opacity == 0.95)
    app.queue.put(intents.SetNote("seen by all"))
    app.queue.put(intents.Released())
    _agree(tabs)
    second.page.reload()
    second.wait_until_ready()
    _agree([*tabs, open_tab(app, WINDOW)])


def test_a_tab_that_is_closed_in_mid_drag_leaves_a_saved_edit_and_no_stale_picture(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_marked()
    dragged, second, third = tabs = [open_tab(app, WINDOW) for _ in range(3)]
    start = _joint(app)
    box = dragged.page.locator(
        f"[id='{app.page.element_id(app.joints.slider('PSM1', 0))}'] [role=slider]"
    ).bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    dragged.page.mouse.move(x, y)
    dragged.page.mouse.down()
    for step in range(15):
        dragged.page.mouse.move(x + step, y)
    eventually(lambda: abs(_joint(app) - start), lambda moved: moved > 1.0)
    assert app.state.unsaved
    dragged.page.close()
    # Nobody has let go of the slider, so the edit is saved when its time is over.
    eventually(lambda: app.state.unsaved, lambda unsaved: not unsaved)
    assert app.state.undoable == 1
    _agree(tabs[1:])
    # The others are not held up by a tab that will never say that it has drawn anything.
    value = round(app.joints.slider("PSM1", 0).value - 4.0, 2)
    second.type_value(app.joints.slider("PSM1", 0), value)
    eventually(lambda: app.state.undoable, lambda steps: steps == 2)
    _agree([second, third])


def test_one_worker_does_what_three_tabs_ask_for_and_loses_nothing_of_it(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer(frames=12)
    tabs = [open_tab(app, WINDOW) for _ in range(3)]
    for _ in range(3):
        for tab in tabs:
            tab.page.keyboard.press("n")
    eventually(lambda: app.state.index, lambda index: index == 9)
    for tab in tabs:
        tab.page.keyboard.press("o")
    eventually(lambda: app.state.undoable, lambda steps: steps == 3)
    for tab in tabs:
        expect(tab.page.get_by_text("(10 of 12)")).to_be_visible(timeout=20_000)


def test_a_run_that_one_tab_starts_is_seen_and_paused_by_the_others(
    open_viewer: Callable[..., ViewerApp], open_tab: Callable[..., Tab]
) -> None:
    app = open_viewer()
    run_without_end(app)
    first, second, third = (open_tab(app, WINDOW) for _ in range(3))
    first.button("Run")
    for tab in (second, third):
        expect(tab.page.locator(".carts-status")).to_contain_text("running", timeout=30_000)
    second.button("Pause")
    eventually(lambda: app.state.run.phase, lambda phase: phase is Phase.PAUSED)
    for tab in (first, third):
        expect(tab.page.get_by_role("button", name="Continue", exact=True)).to_be_enabled(timeout=20_000)


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
            assert page.url == plain and "carts-" not in page.evaluate("document.cookie")
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
