"""Overlay of the tracked arms for a surgeon's console: outlines on a key colour, as uncompressed video in pipes."""

import logging
import queue
import threading
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import BinaryIO

import av
import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from ..files import pipe_stream
from ..model.camera import Camera
from ..model.scene import Scene, SceneState
from ..recording import Sequence
from ..rendering import Renderer
from .loop import Tracked
from .tracker import LiveVerdict

KEY = (0, 255, 0)
"""Colour that the console replaces by its own image, RGB."""
COLOURS = {LiveVerdict.GOOD: (255, 0, 255), LiveVerdict.DOUBTFUL: (255, 140, 0)}
"""Outline colours by verdict, RGB, far from the key colour; lost arms have no outline."""
_WIDTH = 3
"""Width of the outlines [px]."""
_RATE = 30
"""Nominal frame rate in the header; readers should display each picture on arrival."""
_PATIENCE = 1.0
"""Maximum waiting time for a reader at the end [s]."""
_log = logging.getLogger(__name__)


def keyed(mask: Bool[np.ndarray, "height width"], verdict: LiveVerdict) -> UInt8[np.ndarray, "height width 3"]:
    """RGB picture of the outline of a mask on the key colour; only the key colour if the arms are lost."""
    picture = np.full((*mask.shape, 3), KEY, np.uint8)
    if (colour := COLOURS.get(verdict)) is not None:
        contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, contours, -1, colour, _WIDTH)
    return picture


class _Pipe:
    """Video of a camera, written to a named pipe."""

    def __init__(self, scene: Scene, camera: Camera, stream: BinaryIO) -> None:
        self._camera = camera
        self._renderer = Renderer(scene, cameras=[camera.name], window=camera.recorded_window)
        self._container = av.open(stream, "w", format="yuv4mpegpipe", container_options={"flush_packets": "1"})
        self._video = self._container.add_stream("rawvideo", rate=_RATE)
        self._video.width, self._video.height, self._video.pix_fmt = camera.width, camera.height, "yuv444p"

    def draw(self, state: SceneState, verdict: LiveVerdict) -> None:
        mask = self._camera.distorted_mask(self._renderer.segment(state)[0] >= 0)
        picture = av.VideoFrame.from_ndarray(keyed(mask, verdict), format="rgb24")
        self._container.mux(self._video.encode(picture))


class KeyedOverlay:
    """Sink that draws the newest result on its own thread, in the pixels of the recorded images.

    The video is YUV4MPEG2 with full chroma resolution, so that the key colour ends at the outlines.

    Args:
        sequence: sequence with the arms and cameras.
        pipes: camera -> named pipe, whose reader is already running.

    Raises:
        OutputError: a pipe is missing, is not a pipe, or has no reader.
    """

    def __init__(self, sequence: Sequence, pipes: Mapping[str, Path]) -> None:
        scene = sequence.scene.with_cameras(tuple(pipes))
        with ExitStack() as held:
            streams = {name: held.enter_context(pipe_stream(path)) for name, path in pipes.items()}
            self._pipes = [_Pipe(scene, sequence.recorded_camera(name), stream) for name, stream in streams.items()]
            self._held = held.pop_all()
        self._waiting: queue.Queue[Tracked | None] = queue.Queue(1)
        self._thread = threading.Thread(target=self._run, name="carts-live-overlay", daemon=True)
        self._thread.start()

    def __call__(self, tracked: Tracked) -> None:
        """Queue a result; it replaces a result that is still queued."""
        with suppress(queue.Empty):
            self._waiting.get_nowait()
        self._waiting.put(tracked)

    def close(self) -> None:
        """End the video after the last result; a picture that is not read within a second is dropped."""
        with suppress(queue.Full):
            self._waiting.put(None, timeout=_PATIENCE)
        self._thread.join(_PATIENCE)

    def _run(self) -> None:
        try:
            # After the exit of one reader all pipes are closed, so that no other reader shows an old outline.
            with self._held:
                while (tracked := self._waiting.get()) is not None:
                    state, verdict = tracked.estimate.state.to("cpu"), tracked.estimate.verdict
                    if verdict is LiveVerdict.GOOD and not tracked.current:
                        verdict = LiveVerdict.DOUBTFUL
                    for pipe in self._pipes:
                        pipe.draw(state, verdict)
        except BrokenPipeError:
            _log.warning("A reader of the overlay has exited; tracking continues without an overlay.")
            while self._waiting.get() is not None:
                pass
