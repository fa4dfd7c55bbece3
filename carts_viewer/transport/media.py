"""Pictures that documents over the page show: served from memory, to whom the page is served."""

import hashlib
import http
import threading
from collections import OrderedDict

from websockets.http11 import Response

from carts_viewer.transport.gate import response

MEDIA = "/media/"
_MOST = 256
"""How many are kept; the oldest go first."""


class Media:
    """Pictures by names that follow from their content."""

    def __init__(self) -> None:
        self._contents: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def publish(self, jpeg: bytes) -> str:
        """Serve a JPEG file from now on; gives its address."""
        name = f"{hashlib.sha256(jpeg).hexdigest()[:24]}.jpg"
        with self._lock:
            self._contents[name] = jpeg
            self._contents.move_to_end(name)
            while len(self._contents) > _MOST:
                self._contents.popitem(last=False)
        return MEDIA + name

    def answer(self, name: str) -> Response:
        """The picture of a name, or that there is none."""
        with self._lock:
            content = self._contents.get(name)
        if content is None:
            return response(http.HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"No such picture.")
        return response(http.HTTPStatus.OK, "image/jpeg", content)
