"""The document over the page in a browser: what people do there survives that the server writes it anew."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser
from playwright.sync_api import Page as Tab
from viewer_tab import new_context
from waiting import eventually, wait_in

from carts_viewer.transport.document import Document
from carts_viewer.transport.events import Chosen
from carts_viewer.transport.page import Page

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def opened(browser: Browser) -> Iterator[tuple[Document, Tab]]:
    page = Page(host="127.0.0.1", port=0, title="Document")
    context = new_context(browser)
    try:
        document, tab = Document(page), context.new_page()
        show(document, 1)
        tab.goto(page.url)
        tab.get_by_text("step 1").wait_for()
        yield document, tab
    finally:
        context.close()
        page.close()


def show(document: Document, step: int) -> None:
    document.show(
        f"<p>step {step}</p><input type='text' data-do='name' value='old'>"
        "<button type='button' data-do='stop'>Stop</button>"
    )


def test_a_button_that_is_written_anew_while_it_is_pressed_is_pressed(opened: tuple[Document, Tab]) -> None:
    document, tab = opened
    chosen: list[tuple[str, str]] = []
    document.page.listen(Chosen, lambda _, event: chosen.append((event.name, event.value)))
    tab.locator("main button").hover()
    tab.mouse.down()
    tab.evaluate("""() => {
        const show = carts.showDocument;
        carts.showDocument = (...what) => { window.shown = true; show(...what); };
    }""")
    show(document, 2)
    wait_in(tab, "window.shown")
    tab.mouse.up()
    eventually(lambda: chosen, lambda said: said == [("stop", "")])
    tab.get_by_text("step 2").wait_for()


def test_text_being_typed_survives_what_the_server_writes(opened: tuple[Document, Tab]) -> None:
    document, tab = opened
    show(document, 3)
    tab.get_by_text("step 3").wait_for()
    field = tab.locator("main input[data-do=name]")
    field.focus()
    field.press("End")
    tab.keyboard.type(" na")
    show(document, 4)
    tab.get_by_text("step 4").wait_for()
    tab.keyboard.type("me")
    assert field.input_value() == "old name"
