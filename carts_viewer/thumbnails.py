"""Small pictures of frames for the page's timeline, made when they are asked for, on a thread of their own."""

import asyncio
import http
import re
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor

import cv2
from websockets.http11 import Response

from carts_core.errors import CartsError
from carts_core.recording import Sequence
from carts_core.recording.images import ImageSource
from carts_core.recording.video import Video
from carts_viewer.transport.gate import response

HEIGHT = 64
"""[px]; shown smaller, so that they stay sharp where a CSS pixel is more than one of the screen."""
_MOST = 4000
"""How many are kept, some 3 kB each; those that were not asked for the longest go first."""
_QUALITY = 70
_PATH = re.compile(r"(\d{1,4})/(\d{1,4})/(\d{1,9})\.jpg")


class Thumbnails:
    """Of one sequence."""

    def __init__(self, sequence: Sequence) -> None:
        self._sequence = sequence
        self._cameras = [camera.name for camera in sequence.scene.cameras]
        self._sources: dict[tuple[int, int], ImageSource] = {}
        self._kept: OrderedDict[str, bytes] = OrderedDict()
        self._lock = threading.Lock()
        # One at a time: whoever scrubs meanwhile needs the processor more.
        self._thread = ThreadPoolExecutor(1, "carts-thumbnails")

    async def answer(self, path: str) -> Response:
        """The picture at `CAMERA/DOMAIN/FRAME.jpg`, all of them numbers from 0, or that there is none."""
        content = self._find(path)
        if content is None:
            try:
                content = await asyncio.get_running_loop().run_in_executor(self._thread, self._make, path)
            except RuntimeError:  # The viewer is being closed.
                content = None
        if content is None:
            return response(http.HTTPStatus.NOT_FOUND, "text/plain; charset=utf-8", b"No such picture.")
        return response(http.HTTPStatus.OK, "image/jpeg", content)

    def close(self) -> None:
        """Make no more pictures."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _source(self, camera: int, domain: int) -> ImageSource:
        """Images as recorded; a video is read apart from whoever goes through its frames meanwhile."""
        if (camera, domain) not in self._sources:
            source = self._sequence.image_source(self._cameras[camera], self._sequence.domains[domain])
            self._sources[camera, domain] = source.another() if isinstance(source, Video) else source
        return self._sources[camera, domain]

    def _find(self, path: str) -> bytes | None:
        with self._lock:
            if path in self._kept:
                self._kept.move_to_end(path)
            return self._kept.get(path)

    def _make(self, path: str) -> bytes | None:
        found = _PATH.fullmatch(path)
        if found is None:
            return None
        camera, domain, frame = map(int, found.groups())
        known = camera < len(self._cameras) and domain < len(self._sequence.domains) and frame < len(self._sequence)
        if not known:
            return None
        try:
            image = self._source(camera, domain).read(frame)
        except CartsError:
            return None
        width = max(round(HEIGHT * image.shape[1] / image.shape[0]), 1)
        small = cv2.resize(image, (width, HEIGHT), interpolation=cv2.INTER_AREA)
        content = cv2.imencode(".jpg", small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        with self._lock:
            self._kept[path] = content
            while len(self._kept) > _MOST:
                self._kept.popitem(last=False)
        return content
