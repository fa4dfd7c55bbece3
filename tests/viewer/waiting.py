"""Asking a running viewer, and waiting for it."""

import http.client
import time
from collections.abc import Callable

from playwright.sync_api import Error, Page


def get(url: str, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """The answer to a request, to the server that an address names."""
    connection = http.client.HTTPConnection(url.removeprefix("http://").partition("/")[0], timeout=20)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    """Return once a condition holds; an error if it does not in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"it did not come true in {seconds:g} s"
        time.sleep(0.02)


def wait_in(page: Page, expression: str, seconds: float = 60.0) -> None:
    """Return once an expression holds in a tab; an error if it does not in time.

    Playwright's own `wait_for_function` evaluates a text in the page, which the page's policy forbids.
    """

    def holds() -> bool:
        try:
            return page.evaluate(f"Boolean({expression})")
        except Error as error:  # The page is being loaded, or its script is not there yet.
            if "context was destroyed" in str(error) or "is not defined" in str(error):
                return False
            raise

    wait_for(holds, seconds)
