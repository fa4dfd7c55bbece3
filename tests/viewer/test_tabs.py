"""Several tabs in headless Chromium: each has its own frame and settings in one project; addresses and tokens."""

import math
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from viewer_tab import OpenTab, Tab, new_context, place_of, widget
from waiting import eventually, wait_in

from carts_viewer.actions import intents
from carts_viewer.app import ViewerApp
from tools.raw_tab import RawTab

pytestmark = pytest.mark.browser

EVERYWHERE = ".".join("0000")
WINDOW = (1100, 720)


def shows_its_own(tab: Tab) -> None:
    """Wait until a tab shows its state in the viewer: frame, joint, opacity, note, history and the picture itself."""
    tab.app.wait_until_shown()
    state, joint = tab.state, tab.slider("PSM1", 0)
    for handle, value in (
        (tab.find("Frame"), state.index + 1),
        (joint, joint.value),
        (tab.find("Opacity %"), round(100 * state.opacity)),
    ):
        expect(tab.field(handle)).to_have_value(f"{value:g}")
    place = f"{state.frame.frame_id} of {len(tab.app.sequence)}"
    expect(tab.page.locator(".carts-strip output")).to_contain_text(place)
    tab.open("Review")
    expect(tab.page.locator(".mantine-TextInput-input:visible").first).to_have_value(state.review.note)
    expect(tab.page.locator(tab.element(tab.find("Go to")))).to_have_value(tab.find("Go to").value)
    tab.canvas.wait_until_registered()
    tab.open("Optimize")


def joint_of(tab: Tab) -> float:
    return math.degrees(float(tab.state.pose.scene.joint_positions[0][0]))


def test_tabs_have_frames_of_their_own_and_one_project_also_after_a_reload(open_tab: OpenTab) -> None:
    first = open_tab(window=WINDOW, marked=True)
    app = first.app
    second = open_tab(app, WINDOW)
    second.put(intents.SetOpacity(1.0))
    first.type_value(first.find("Frame"), 2)
    eventually(lambda: first.state.index, lambda index: index == 1)
    value = round(second.slider("PSM1", 0).value - 3.0, 2)
    second.type_value(second.slider("PSM1", 0), value)
    eventually(lambda: joint_of(second), lambda at: abs(at - value) < 1e-3)
    assert [tab.state.index for tab in (first, second)] == [1, 0]
    eventually(lambda: [tab.state.undoable for tab in (first, second)], lambda steps: steps == [1, 1])
    shows_its_own(first)
    shows_its_own(second)
    first.page.reload()
    first.wait_until_ready()
    assert first.state.index == 1 and "frame=2" in first.page.url
    shows_its_own(first)


def test_undo_and_redo_can_be_pressed_as_soon_as_the_other_tab_has_left(shared_viewer: ViewerApp) -> None:
    app = shared_viewer
    with RawTab(app.url) as raw:
        undo, redo = (widget(app, raw, name) for name in ("Undo", "Redo"))
        with RawTab(app.url) as other:
            place_of(app, other).put(intents.Nudge(1.0))
            app.wait_until_shown()
            assert undo.disabled
        eventually(lambda: not undo.disabled)
        place_of(app, raw).put(intents.Undo())
        app.wait_until_shown()
        assert not app.project.state.joints(0) and not redo.disabled


def test_a_link_opens_its_frame_camera_and_domain_and_takes_no_other_tab_along(open_tab: OpenTab) -> None:
    query = "/?project=tiny&frame=3&camera=right&domain=smoke"
    tab = open_tab(query=query, cameras=("left", "right"), domains=("regular", "smoke"))
    state = tab.state
    assert (state.index, state.camera, state.domain) == (2, "right", "smoke")
    wait_in(tab.page, "location.search.includes('domain=smoke') && location.search.includes('frame=3')")
    link = tab.page.url
    with RawTab(tab.app.url) as other:
        assert place_of(tab.app, other).controller.state.index == 0
    tab.type_value(tab.find("Frame"), 1)
    wait_in(tab.page, "location.search.includes('frame=1')")
    tab.page.goto(link.replace("project=tiny", "project=elsewhere"))
    expect(tab.page.get_by_text("This link is for elsewhere")).to_be_visible()


def test_the_token_of_the_address_is_used_up_by_the_page_and_reloading_works(
    tiny_sequence: Callable[..., Path], untrained_weights: Path, browser: Browser
) -> None:
    with ViewerApp.open(tiny_sequence(), host=EVERYWHERE, port=0, weights=(untrained_weights,)) as app:
        plain = f"http://127.0.0.1:{app.page.server.get_port()}/"
        with closing(new_context(browser)) as context, closing(new_context(browser)) as stranger:
            page = context.new_page()
            page.goto(plain + "?" + app.url.partition("?")[2])
            tab = Tab(app, page)
            tab.wait_until_ready()
            assert page.url.startswith(plain) and "token" not in page.url
            assert "carts-" not in page.evaluate("document.cookie")
            page.reload()
            tab.wait_until_ready()
            tab.press("n")
            eventually(lambda: app.state.index, lambda index: index == 1)
            answer = stranger.new_page().goto(plain)
            assert answer is not None and answer.status == 403
