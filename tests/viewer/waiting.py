"""Requests to a running viewer, and waits for conditions."""

import http.client
import time
from collections.abc import Callable
from typing import TypeVar

from playwright.sync_api import Error, Page

T = TypeVar("T")
PATIENCE = 120.0
"""Longest wait for a condition, on a busy machine [s]."""


def get(url: str, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """The answer to a request, from the server that an address names."""
    connection = http.client.HTTPConnection(url.removeprefix("http://").partition("/")[0], timeout=PATIENCE)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def eventually(read: Callable[[], T], good: Callable[[T], object] = bool, timeout: float = PATIENCE) -> T:
    """Read until the value is good; an error with the last value after `timeout` [s]."""
    end = time.monotonic() + timeout
    while not good(value := read()):
        assert time.monotonic() < end, f"still {value!r} after {timeout:g} s"
        time.sleep(0.02)
    return value


def wait_in(page: Page, expression: str, timeout: float = PATIENCE) -> None:
    """Return once an expression holds in a tab.

    Playwright's own `wait_for_function` evaluates a text in the page, which the page's policy forbids.
    """

    def holds() -> bool:
        try:
            return page.evaluate(f"Boolean({expression})")
        except Error as error:  # The page is being loaded, or its script is not there yet.
            if "context was destroyed" in str(error) or "is not defined" in str(error):
                return False
            raise

    eventually(holds, timeout=timeout)
