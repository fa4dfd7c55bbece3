"""The sheet of all frames and the list of actions, in headless Chromium."""

import pytest
from playwright.sync_api import expect
from viewer_tab import OpenTab
from waiting import eventually

from carts_core.project import ReviewState
from carts_viewer.actions import intents
from carts_viewer.panels.frames import frame_values

pytestmark = pytest.mark.browser


def test_frames_are_filtered_chosen_and_reviewed_together(open_tab: OpenTab) -> None:
    tab = open_tab(frames=6, width=160, height=120)
    app, page = tab.app, tab.page
    tab.put(intents.Perturb(2.0, 0), intents.Assess(), intents.SetNote("jaw"), intents.Released())
    page.get_by_role("button", name="Frames", exact=True).click()
    sheet = page.get_by_role("dialog", name="Frames")
    rows = sheet.locator("tbody tr")
    expect(rows).to_have_count(6)
    expect(sheet.locator("output")).to_contain_text("worst 1 of 1")
    # The assessed frame is the worst, hence the first; its values are those of the project.
    verdict = eventually(lambda: app.state.verdict)
    assert verdict is not None and frame_values(app.state.project)[0][2:] == [verdict.failure, "jaw", 1]
    for text in ("001", verdict.verdict, f"{100 * verdict.failure:.0f} %", "jaw"):
        expect(rows.first).to_contain_text(text)
    for first in ("001", "006"):
        sheet.get_by_role("button", name="Frame", exact=True).click()
        expect(rows.first).to_contain_text(first)
    before = app.state.project.position
    rows.nth(2).click()
    rows.nth(4).click(modifiers=["Shift"])
    expect(sheet.locator("output")).to_contain_text("3 chosen")
    names = [row.locator("td").first.inner_text() for row in rows.all()[2:5]]
    sheet.get_by_role("button", name="Reject", exact=True).click()
    frames = [int(name) - 1 for name in names]
    eventually(lambda: [app.state.project.review(i).state for i in frames], lambda all: set(all) == {"rejected"})
    assert app.state.project.position == before + 1
    sheet.get_by_label("Review").select_option("rejected")
    expect(rows).to_have_count(3)
    sheet.get_by_role("searchbox").fill("jaw")
    expect(rows).to_have_count(0)
    sheet.get_by_role("searchbox").fill(names[0])
    rows.first.dblclick()
    expect(sheet).to_be_hidden()
    eventually(lambda: app.state.index, lambda index: index == frames[0])
    # Frames that do not exist are ignored.
    tab.put(intents.ReviewFrames([-1, 2, 99], ReviewState.ACCEPTED))
    assert app.state.project.review(2).state == "accepted"
    tab.put(intents.ReviewFrames([99], ReviewState.ACCEPTED))
    expect(page.get_by_role("alert")).to_contain_text("None of the 1 frames")


def test_the_list_of_actions_finds_buttons_and_functions_of_the_page(open_tab: OpenTab) -> None:
    tab = open_tab(frames=3, width=160, height=120)
    page = tab.page
    search = page.get_by_placeholder("Search commands...")
    expect(page.get_by_role("button", name="Find an action (Ctrl+K)")).to_be_visible()
    for text, label in (("solve", "Solve all"), ("discard", "Discard all"), ("light", "Light or dark")):
        tab.press("Control+k")
        search.fill(text)
        expect(page.locator(".mantine-Spotlight-action").filter(has_text=label).first).to_be_visible()
        tab.press("Escape")
        expect(search).to_have_count(0)
    # Of viser's own widgets neither the settings for developers nor the scene tree can be opened.
    expect(page.get_by_text("Scene tree")).to_be_hidden()
    assert page.locator("[data-dock-header] button:visible").count() == 1
