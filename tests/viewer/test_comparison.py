"""Comparisons of poses and masks: their pictures, and the line between two states in headless Chromium."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from viewer_desk import Desk
from viewer_tab import OpenTab, box_of
from waiting import eventually

from carts_core.project import MaskCorrection, ReviewState
from carts_viewer.actions import intents
from carts_viewer.picture.comparison import LINES, compared_pose, legend, outlines, painted
from carts_viewer.picture.layers import ADDED_COLOR, REMOVED_COLOR
from carts_viewer.state import ComparedPose, CompareMode


def _drawn(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    return (picture[..., :3] == color).all(-1) & (picture[..., 3] > 0)


def test_outlines_follow_the_arms_and_differ_without_colour() -> None:
    ids = np.full((240, 320), -1)
    ids[60:180, 0:200] = 0
    inside = (ids >= 0).astype(np.uint8)
    edge = inside - cv2.erode(inside, np.ones((3, 3), np.uint8), borderValue=1)
    distance = cv2.distanceTransform(1 - edge, cv2.DIST_L2, 5)
    dashes = {}
    for which, style in LINES.items():
        drawn = _drawn(outlines({which: ids}, ids.shape), style.color)
        assert distance[drawn].max() <= 2
        assert not drawn[80:160, :2].any()  # the image's border is no outline
        dashes[which] = (np.diff(drawn[58:63, 10:190].any(0).astype(int)) == 1).sum()
    assert dashes[ComparedPose.CURRENT] == 0
    assert 15 < 1.5 * dashes[ComparedPose.ACCEPTED] < dashes[ComparedPose.MEASURED]


def test_a_painted_mask_shows_what_was_added_and_removed() -> None:
    rendered = np.full((60, 80), -1)
    rendered[20:40, 10:50] = 0
    added, removed = np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    added[10:20, 10:30], removed[30:40, 10:30] = True, True
    before, after = painted(rendered, MaskCorrection.of(added, removed), "left", 0.5)
    assert np.array_equal(before[..., 3] > 0, rendered >= 0)
    assert np.array_equal(_drawn(after, ADDED_COLOR), added)
    stripes = _drawn(after, REMOVED_COLOR)
    assert not (stripes & ~removed).any() and 0.4 < stripes.sum() / removed.sum() < 0.6
    assert np.array_equal(painted(rendered, None, "left", 0.5)[1], before)


def test_the_accepted_pose_is_that_of_the_last_acceptance(desk: Desk) -> None:
    def accepted() -> list[float]:
        found = compared_pose(ComparedPose.ACCEPTED, desk.controller.state, desk.session)
        return [] if found is None else np.concatenate(found.joint_positions).tolist()

    desk.do(intents.Perturb(1.0, 0), intents.CompareWith(CompareMode.OUTLINES))
    assert accepted() == []
    first = np.concatenate(desk.controller.state.pose.scene.joint_positions).tolist()
    desk.do(intents.SetReview(ReviewState.ACCEPTED))
    assert accepted() == first
    state = desk.do(intents.Perturb(3.0, 1))
    assert state.review.state is not ReviewState.ACCEPTED and accepted() == first
    desk.do(intents.ShowFrame(1))
    assert accepted() == []
    state = desk.do(intents.ShowFrame(0), intents.GoToStep(1))
    assert accepted() == [] and "none" in str(legend(state, {ComparedPose.ACCEPTED: None}))


def test_a_missing_image_is_named(desk: Desk) -> None:
    state = desk.do(intents.CompareWith(None))
    assert legend(state, {}) == []
    missing = replace(state, frame=replace(state.frame, missing=(state.camera,)))
    assert "no image" in str(legend(missing, {}))


@pytest.mark.browser
def test_the_line_between_two_states_is_dragged_named_and_used_by_keys(open_tab: OpenTab) -> None:
    tab = open_tab(marked=True)
    page = tab.page
    tab.put(intents.Perturb(4.0, 0), intents.CompareWith(CompareMode.OUTLINES))
    expect(page.locator(".carts-lines li")).to_have_text(["Measured", "Current", "Accepted: none"])
    tab.put(intents.CompareWith(CompareMode.SWIPE, ComparedPose.ACCEPTED, ComparedPose.MEASURED))
    line = page.locator(".carts-swipe")
    expect(line).to_have_attribute("aria-label", "Accepted: none | Measured")
    tab.put(intents.CompareWith(CompareMode.SWIPE))
    expect(line.locator("span")).to_have_text(["Measured", "Current"])
    x, y = tab.place(160, 100)
    tab.drag((x, y), tab.place(80, 100))
    eventually(lambda: tab.state.compare.swipe, lambda share: share == pytest.approx(0.25, abs=0.01))
    box = box_of(line)
    assert box["x"] + box["width"] / 2 == pytest.approx(tab.place(80, 100)[0], abs=2)
    line.focus()
    tab.press("ArrowRight")
    eventually(lambda: tab.state.compare.swipe, lambda share: share == pytest.approx(0.27, abs=0.01))
    tab.press("Home")
    eventually(lambda: tab.state.compare.swipe, lambda share: share == 0.0)
    assert tab.state.index == 0
    page.reload()
    tab.wait_until_ready()
    expect(line).to_have_attribute("aria-valuenow", "0")
