"""The page behind reverse proxies (nginx with HTTPS, a sub path and strict origins; jupyter-server-proxy), and in a
frame of a notebook."""

import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from viewer_tab import READY, new_context
from waiting import eventually, wait_in
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import carts_viewer
from carts_core.errors import SettingsError
from carts_viewer.app import ViewerApp
from carts_viewer.transport.guard import Guard, Proxy

BASE = "/labs/x"
_NGINX = """
daemon off; worker_processes 1; pid {folder}/pid; error_log {folder}/errors;
events {{}}
http {{
  access_log off;
  client_body_temp_path {folder}/a; proxy_temp_path {folder}/b; fastcgi_temp_path {folder}/c;
  uwsgi_temp_path {folder}/d; scgi_temp_path {folder}/e;
  map $http_upgrade $connection_upgrade {{ default upgrade; '' close; }}
  server {{
    listen 127.0.0.1:{port} ssl;
    ssl_certificate {folder}/cert.pem; ssl_certificate_key {folder}/key.pem;
    location {base}/ {{
      proxy_pass http://127.0.0.1:{viewer}{target};
      proxy_http_version 1.1;
      proxy_set_header Host $http_host;
      proxy_set_header Upgrade $http_upgrade;
      proxy_set_header Connection $connection_upgrade;
      proxy_read_timeout 1d;
    }}
  }}
}}
"""


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def _answers(port: int) -> bool:
    with closing(socket.socket()) as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def _running(command: list[str], port: int, **options) -> Iterator[None]:
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **options)
    try:
        eventually(lambda: process.poll() is not None or _answers(port))
        assert process.poll() is None, f"{command[0]} ended with {process.returncode}"
        yield
    finally:
        process.terminate()
        process.wait(20)


@contextmanager
def nginx(folder: Path, viewer: int, port: int, *, keeps_path: bool) -> Iterator[str]:
    """nginx with a self-signed certificate, which keeps or removes the base path; returns the address of the page."""
    if (program := shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")) is None:
        pytest.skip("nginx is not installed: apt-get install nginx-light")
    if shutil.which("openssl") is None:
        pytest.skip("openssl, which makes the certificate, is not installed")
    request = "req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN=127.0.0.1 -keyout key.pem -out cert.pem"
    subprocess.run(["openssl", *request.split()], cwd=folder, check=True, capture_output=True)
    target = f"{BASE}/" if keeps_path else "/"
    text = _NGINX.format(folder=folder, port=port, base=BASE, viewer=viewer, target=target)
    (folder / "nginx.conf").write_text(text)
    with _running([program, "-p", str(folder), "-c", str(folder / "nginx.conf")], port):
        yield f"https://127.0.0.1:{port}{BASE}/"


@pytest.fixture
def open_behind(
    tiny_sequence: Callable[..., Path], untrained_weights: Path
) -> Iterator[Callable[[Proxy], tuple[ViewerApp, int]]]:
    """Function that opens a viewer behind a proxy; also returns its port."""
    with ExitStack() as stack:

        def make(proxy: Proxy) -> tuple[ViewerApp, int]:
            path = tiny_sequence(frames=3)
            app = stack.enter_context(ViewerApp.open(path, port=0, proxy=proxy, weights=(untrained_weights,)))
            app.wait_until_shown()
            return app, app.page.server.get_port()

        yield make


def smoke(browser: Browser, address: str) -> None:
    """Open the page, load thumbnails, show another frame; nothing is missing or refused."""
    with closing(new_context(browser, ignore_https_errors=True)) as context:
        context.add_init_script("localStorage.setItem('carts-tour', 'seen')")
        page = context.new_page()
        failed: list[str] = []
        page.on("response", lambda answer: failed.append(answer.url) if answer.status >= 400 else None)
        page.on("requestfailed", lambda request: failed.append(request.url))
        sockets: list[str] = []
        page.on("websocket", lambda each: sockets.append(each.url))
        with page.expect_response(re.compile(r"/thumbnail/")) as thumbnail:
            page.goto(address)
            wait_in(page, READY)
            page.locator("[data-do=lanes]").first.dispatch_event("click")
        assert thumbnail.value.status == 200 and thumbnail.value.url.startswith(address)
        page.keyboard.press("]")
        expect(page.get_by_role("button", name="Check the fit", exact=True)).to_be_visible()
        assert failed == [] and all(url.startswith(address.replace("http", "ws", 1)) for url in sockets)


@pytest.mark.browser
@pytest.mark.parametrize("keeps_path", [True, False])
def test_the_page_works_through_nginx_with_https_and_a_sub_path(
    browser: Browser, open_behind: Callable, tmp_path: Path, keeps_path: bool
) -> None:
    port = _free_port()
    origin = f"https://127.0.0.1:{port}"
    _, viewer = open_behind(Proxy(BASE if keeps_path else "", (origin,)))
    with nginx(tmp_path, viewer, port, keeps_path=keeps_path) as address:
        smoke(browser, address)
        for other in ("https://evil.example", f"http://127.0.0.1:{port}0", "null", f"http://127.0.0.1:{viewer}"):
            with pytest.raises(InvalidStatus, match="403"):
                connect(address.replace("https", "wss"), origin=other, ssl=_unchecked()).close()  # type: ignore[arg-type]


def _unchecked():
    import ssl  # noqa: PLC0415

    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def test_without_a_trusted_origin_a_proxy_is_refused(open_behind: Callable, tmp_path: Path) -> None:
    port = _free_port()
    _, viewer = open_behind(Proxy(BASE))
    with nginx(tmp_path, viewer, port, keeps_path=True) as address:
        with pytest.raises(InvalidStatus, match="403"):
            connect(address.replace("https", "wss"), origin=f"https://127.0.0.1:{port}", ssl=_unchecked())  # type: ignore[arg-type]


@pytest.mark.browser
def test_the_page_works_through_jupyter_server_proxy(browser: Browser, open_behind: Callable, tmp_path: Path) -> None:
    port = _free_port()
    _, viewer = open_behind(Proxy("", (f"http://127.0.0.1:{port}",)))
    command = [sys.executable, "-m", "jupyter_server", f"--ServerApp.port={port}", "--ServerApp.ip=127.0.0.1"]
    command += ["--IdentityProvider.token=", "--no-browser", "--allow-root", f"--ServerApp.root_dir={tmp_path}"]
    with _running(command, port):
        smoke(browser, f"http://127.0.0.1:{port}/proxy/{viewer}/")


@pytest.mark.browser
def test_a_notebook_embeds_the_page_and_no_other_site_can(
    browser: Browser, tiny_sequence: Callable[..., Path], untrained_weights: Path, tmp_path: Path
) -> None:
    port, other = _free_port(), _free_port()
    command = [sys.executable, "-m", "http.server", "--bind", "127.0.0.1", "--directory", str(tmp_path)]
    with carts_viewer.view(
        tiny_sequence(), origins=(f"http://localhost:{port}",), height=400, weights=(untrained_weights,)
    ) as shown:
        (tmp_path / "cell.html").write_text(shown._repr_html_())
        with _running([*command, str(port)], port), _running([*command, str(other)], other):
            with closing(new_context(browser)) as context:
                page = context.new_page()
                page.goto(f"http://localhost:{port}/cell.html")
                frame = eventually(lambda: page.frame(url=re.compile(re.escape(shown.url))))
                assert frame is not None
                eventually(lambda: page.frames[-1].evaluate(f"Boolean({READY})"))
                page.goto(f"http://localhost:{other}/cell.html")
                frame = page.frames[-1]
                assert not frame.evaluate("Boolean(window.carts)") and frame.url.startswith("chrome-error:")


def test_origins_and_paths_are_checked() -> None:
    for path in ("x", "/x/", "/a b", "/../x?", "//x"):
        with pytest.raises(SettingsError, match="base path"):
            Proxy(path)
    for origin in ("host", "https://host/", "https://*", "https://Host", "ftp://host", "https://a@host"):
        with pytest.raises(SettingsError, match="trusted origin"):
            Proxy("", (origin,))
    proxy = Proxy(BASE, ("https://lab.example",))
    assert proxy.inside(f"{BASE}/static/a.js?b") == "/static/a.js?b" and proxy.inside(BASE) is None
    assert proxy.inside("/labs/xy") == "/labs/xy" and proxy.inside("/") == "/"
    assert Guard("127.0.0.1", proxy).cookie("/", None) is None  # type: ignore[arg-type]
