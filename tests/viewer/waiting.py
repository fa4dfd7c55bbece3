"""Asking a running viewer, and waiting for it."""

import http.client
import time
from collections.abc import Callable


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
