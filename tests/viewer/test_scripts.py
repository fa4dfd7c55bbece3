"""The page and its document: nothing foreign runs as a script, and user input survives updates by the server."""

import http.server
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import Browser
from playwright.sync_api import Page as Tab
from viewer_tab import new_context
from waiting import eventually, get, wait_in

from carts_viewer.transport.document import Document
from carts_viewer.transport.events import Chosen
from carts_viewer.transport.page import Page

pytestmark = pytest.mark.browser


@dataclass
class OtherSite:
    """Web server of another origin."""

    address: str
    page: str = ""
    asked: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def other_site() -> Iterator[OtherSite]:
    """Handler that serves one page, and records requests."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            site.asked.append(self.path)
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(site.page.encode())

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        site = OtherSite(f"http://localhost:{server.server_address[1]}")
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield site
        server.shutdown()


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    page = Page(host="127.0.0.1", port=0, title="Scripts")
    yield page
    page.close()


@contextmanager
def opened(browser: Browser, page: Page) -> Iterator[Tab]:
    """Page that records executed scripts and blocked requests."""
    with closing(new_context(browser)) as context:
        tab = context.new_page()
        tab.add_init_script(
            "window.ran = []; window.blocked = [];"
            "document.addEventListener('securitypolicyviolation', (event) => blocked.push(event.effectiveDirective));"
        )
        tab.goto(page.url)
        wait_in(tab, "window.carts && window.__viserMutable?.canvas")
        yield tab


@pytest.fixture(scope="module")
def attacked(browser: Browser, page: Page) -> Iterator[Tab]:
    with opened(browser, page) as tab:
        yield tab


@pytest.fixture
def tab(browser: Browser, page: Page) -> Iterator[Tab]:
    with opened(browser, page) as tab:
        yield tab


def test_what_is_injected_into_the_page_neither_runs_nor_loads(attacked: Tab, other_site: OtherSite) -> None:
    for directive, injected in (
        ("script-src-elem", "append(Object.assign(document.createElement('script'), {textContent: 'ran.push(1)'}))"),
        ("script-src-elem", "append(Object.assign(document.createElement('script'), {src: OTHER + '/script.js'}))"),
        ("script-src-attr", "innerHTML = `<img src=x onerror='ran.push(1)'>`"),
        ("script-src-attr", "innerHTML = `<svg onload='ran.push(1)'></svg>`"),
        ("script-src-elem", "innerHTML = `<a href='javascript:ran.push(1)'>x</a>`; box.firstChild.click()"),
        ("img-src", "innerHTML = `<img src='${OTHER}/image.png'>`"),
        ("img-src", "innerHTML = `<div style='background: url(${OTHER}/style.png)'>x</div>`"),
        ("style-src-elem", "innerHTML = `<link rel='stylesheet' href='${OTHER}/style.css'>`"),
        ("frame-src", "innerHTML = `<iframe src='${OTHER}/frame'></iframe>`"),
        ("object-src", "innerHTML = `<object data='${OTHER}/object'></object>`"),
        ("form-action", "innerHTML = `<form action='${OTHER}/form'></form>`; box.firstChild.submit()"),
        ("base-uri", "append(Object.assign(document.createElement('base'), {href: OTHER}))"),
    ):
        attacked.evaluate("() => { ran.length = blocked.length = 0; }")
        box = "const box = document.body.appendChild(document.createElement('div')); box."
        attacked.evaluate(f"() => {{ const OTHER = '{other_site.address}'; {box}{injected}; }}")
        eventually(lambda directive=directive: directive in attacked.evaluate("blocked"))
        assert attacked.evaluate("ran") == [] and other_site.asked == [], injected


def test_a_worker_of_the_page_connects_to_no_other_server(attacked: Tab, other_site: OtherSite) -> None:
    """viser's client, which is one, would connect to any server that a link names in `?websocket=`."""
    connect = """(address) => new Promise((done) => {
        const source = `addEventListener("securitypolicyviolation", (event) => postMessage(event.effectiveDirective));
            new WebSocket(${JSON.stringify(address)});`;
        new Worker(URL.createObjectURL(new Blob([source]))).onmessage = ({ data }) => done(data);
    })"""
    assert attacked.evaluate(connect, other_site.address.replace("http", "ws", 1)) == "connect-src"
    assert other_site.asked == []


def test_a_script_of_the_server_is_no_code_in_the_page(attacked: Tab) -> None:
    tab = attacked
    tab.evaluate("() => { ran.length = 0; }")
    for source in ("ran.push(1)", 'carts.tell("x")', "return ran"):
        assert tab.evaluate("(source) => typeof Function(source)() + typeof new Function(source)()", source)
    call = '{"name": "setHints", "args": [{}]}'
    assert (
        tab.evaluate("(source) => { carts.setHints = (hints) => ran.push(hints); Function(source)(); }", call) is None
    )
    assert tab.evaluate("ran") == [{}]


def test_of_a_document_only_what_documents_are_made_of_is_shown(tab: Tab, page: Page, other_site: OtherSite) -> None:
    document = Document(page)
    document.show(
        "<h1 onclick='ran.push(1)' class='kept'>Title</h1><script>ran.push(1)</script><iframe srcdoc='<b>'></iframe>"
        f"<img src='{other_site.address}/i.png' onerror='ran.push(1)'><img src='media/0a.jpg'>"
        "<a href='javascript:1'>x</a>"
        "<svg><polyline points='0,0 1,1'/><animate onbegin='ran.push(1)'/><foreignObject><b>x</b></foreignObject></svg>"
    )
    tab.get_by_role("heading", name="Title").wait_for()
    assert tab.locator("main").inner_html() == (
        '<h1 class="kept">Title</h1><img><img src="media/0a.jpg"><svg><polyline points="0,0 1,1"></polyline></svg>'
    )
    assert tab.evaluate("ran") == [] and other_site.asked == []
    document.show("")


def show(document: Document, step: int) -> None:
    document.show(
        f"<p>step {step}</p><input type='text' data-do='name' value='old'>"
        "<button type='button' data-do='stop'>Stop</button>"
    )


def test_a_pressed_button_and_text_being_typed_survive_what_the_server_writes(tab: Tab, page: Page) -> None:
    document = Document(page)
    show(document, 1)
    tab.get_by_text("step 1").wait_for()
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
    field = tab.locator("main input[data-do=name]")
    field.focus()
    field.press("End")
    tab.keyboard.type(" na")
    show(document, 4)
    tab.get_by_text("step 4").wait_for()
    tab.keyboard.type("me")
    assert field.input_value() == "old name"
    document.show("")


def test_another_sites_page_loads_nothing_of_the_viewer_and_may_link_to_it(
    browser: Browser, page: Page, other_site: OtherSite
) -> None:
    icon, script = f"{page.url}/static/icon.svg", f"{page.url}/static/boot.js"
    other_site.page = (
        f"<img id=icon src='{icon}'><script src='{script}' onload='window.loaded = 1'></script>"
        f"<iframe src='{page.url}'></iframe><a href='{page.url}'>go</a>"
    )
    with closing(new_context(browser)) as context:
        tab = context.new_page()
        tab.goto(other_site.address)
        assert tab.evaluate("[window.loaded, icon.naturalWidth]") == [None, 0]
        tab.get_by_text("go").click()
        wait_in(tab, "window.carts && window.__viserMutable?.canvas")
    for path in ("/", "/static/icon.svg", "/nothing"):
        assert get(page.url, path).headers["Cross-Origin-Resource-Policy"] == "same-origin"
    other_site.asked.clear()


def test_the_page_is_served_with_its_policy_or_not_at_all(page: Page) -> None:
    for path in ("//", "/./", "/index.html/", "/%69ndex.html", "/.//index.html?x"):
        assert get(page.url, path).status == 404, path
