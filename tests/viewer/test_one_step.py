"""In a browser: a drag in the picture is one step of undo, whatever was in use before and however long it takes."""

from collections.abc import Callable

import pytest
from viewer_canvas import eventually
from viewer_tab import Tab

from carts_viewer.app import ViewerApp

pytestmark = pytest.mark.browser


@pytest.mark.parametrize("rest", [400, pytest.param(6000, marks=pytest.mark.slow)])
def test_a_drag_right_after_a_field_was_in_use_or_with_a_rest_on_the_way_is_one_step(
    open_marked: Callable[..., ViewerApp], open_tab: Callable[..., Tab], rest: int
) -> None:
    tab = open_tab(app := open_marked())
    # The field of the frame's slider keeps the focus until the picture is pressed, which lets go of the field.
    tab.page.locator(f"[id='{app.page.element_id(tab.find('Frame'))}'] + * input").click()
    tab.page.keyboard.down("Shift")
    tab.page.mouse.move(*tab.place(150.0, 110.0))
    tab.page.mouse.down()
    tab.page.mouse.move(*tab.place(154.0, 112.0))
    eventually(lambda: app.state.unsaved, bool)
    tab.page.wait_for_timeout(rest)
    tab.page.mouse.move(*tab.place(164.0, 117.0))
    eventually(lambda: app.state.keypoints.pins[-1].pixel, lambda at: at == pytest.approx((164.0, 117.0), abs=1.0))
    assert app.state.unsaved and app.state.undoable == 1
    tab.page.mouse.up()
    tab.page.keyboard.up("Shift")
    eventually(lambda: app.state, lambda state: not state.unsaved)
    assert app.state.undoable == 1
