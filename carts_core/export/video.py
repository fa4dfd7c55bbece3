"""Overlays of the rendered arms on the recorded images, as images and as one video per camera (H.264 in MP4)."""

from contextlib import ExitStack
from fractions import Fraction
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from ..files import OutputPath, output_stream, unique_file_names
from ..model.camera import Camera
from ..model.scene import SceneState
from ..rendering import ImageRenderer
from .dataset import Dataset, ExportProgress, View

if TYPE_CHECKING:
    from av.container import OutputContainer

_CONTOUR = (80, 255, 120)


def image_and_mask(
    renderer: ImageRenderer, state: SceneState
) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """RGB rendering of the first camera, and its mask."""
    images, arms = renderer.shaded(state)
    return (np.moveaxis(images[0], 0, -1) * 255.0).astype(np.uint8), arms[0] >= 0


def overlay(
    frame: UInt8[np.ndarray, "height width 3"],
    image: UInt8[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"],
    opacity: float,
) -> UInt8[np.ndarray, "height width 3"]:
    """Blend an RGB rendering over an RGB frame inside the mask."""
    return np.where(mask[..., None], cv2.addWeighted(frame, 1.0 - opacity, image, opacity, 0.0), frame)


def outlined(
    frame: UInt8[np.ndarray, "height width 3"], mask: Bool[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a bright outline of the mask on an RGB image."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(frame.copy(), contours, -1, _CONTOUR, 1)


_DEFAULT_RATE = 25.0
_OPACITY = 0.5
_QUALITY = {"crf": "18", "preset": "medium"}


class _Video:
    """Video of a camera, black in frames without an image."""

    def __init__(self, container: "OutputContainer", camera: Camera, rate: Fraction) -> None:
        self._container, self._stream = container, container.add_stream("libx264", rate=rate, options=_QUALITY)
        # H.264 requires even widths and heights.
        self._stream.width, self._stream.height = camera.width + camera.width % 2, camera.height + camera.height % 2
        self._stream.pix_fmt = "yuv420p"
        self._black = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._length = 0

    def show(self, number: int, picture: UInt8[np.ndarray, "height width 3"]) -> None:
        """Append a picture as frame `number`, from 0."""
        self._fill(number)
        self._append(picture)

    def finish(self, length: int) -> None:
        """Write the remaining data of a video of `length` frames."""
        self._fill(length)
        self._container.mux(self._stream.encode(None))

    def _fill(self, length: int) -> None:
        while self._length < length:
            self._append(self._black)

    def _append(self, picture: UInt8[np.ndarray, "height width 3"]) -> None:
        import av  # noqa: PLC0415  Not needed by other exports.

        frame = av.VideoFrame.from_ndarray(_padded(picture), format="rgb24")
        self._container.mux(self._stream.encode(frame))
        self._length += 1


def write_video(dataset: Dataset, folder: OutputPath, progress: ExportProgress) -> None:
    """Write `CAMERA.mp4` for every camera, with a picture for each exported frame."""
    import av  # noqa: PLC0415  Not needed by other exports.

    rate = Fraction(frame_rate(dataset)).limit_denominator(1001)
    cameras = dataset.scene.cameras
    names = unique_file_names([camera.name for camera in cameras])
    numbers = {frame.index: number for number, frame in enumerate(dataset.frames)}
    with ExitStack() as stack:
        videos = {}
        for name, camera in zip(names, cameras, strict=True):
            file = stack.enter_context(output_stream(folder / f"{name}.mp4"))
            container = stack.enter_context(av.open(file, "w", format="mp4"))
            videos[camera.name] = _Video(container, camera, rate)
        for view in dataset.views(progress):
            videos[view.camera.name].show(numbers[view.frame.index], _picture(dataset, view))
        for video in videos.values():
            video.finish(len(dataset.frames))


def frame_rate(dataset: Dataset) -> float:
    """Frame rate of a video [1/s]: the given rate, else the median rate of the exported frames, else 25."""
    times = dataset.sequence.timestamps
    if dataset.frame_rate is not None:
        return dataset.frame_rate
    if times is None or len(dataset.frames) < 2:
        return _DEFAULT_RATE
    steps = np.diff([times[frame.index] for frame in dataset.frames])
    return 1.0 / float(np.median(steps)) if np.median(steps) > 0 else _DEFAULT_RATE


def _picture(dataset: Dataset, view: View) -> UInt8[np.ndarray, "height width 3"]:
    state = dataset.state(view.frame)
    image, rendered = image_and_mask(dataset.renderers[view.camera.name], state)
    mask = view.link_ids >= 0
    return outlined(overlay(dataset.image(view), image, rendered & mask, _OPACITY), mask)


def _padded(image: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    height, width = image.shape[:2]
    return cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
