"""Replays, cameras, and folders that fill, as sources of a live stream."""

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from ..errors import SequenceError, SettingsError
from ..files.reading import VALUES, read_bytes
from ..recording import Sequence
from ..recording.images import read_image
from .messages import FrameMessage, ImageMessage, StreamError
from .moments import Assembler, Moment

_log = logging.getLogger(__name__)

_NAMED = 20
"""How many frames that are left out are named."""
_POLL = 0.01
"""How often a folder is looked at [s]."""
_SUFFIXES = (".png", ".jpg", ".jpeg")


class Replay:
    """A recording at the speed of the clock; frames whose time has passed are left out.

    Args:
        sequence: the recording.
        cameras: whose images are wanted.
        domain: in which.
        rate: frames per second, that of the recording's times if None.
        loops: how often it is shown; time goes on from one to the next.

    Raises:
        SettingsError: the recording has no times, and no rate is given.
    """

    def __init__(
        self, sequence: Sequence, cameras: tuple[str, ...], domain: str, *, rate: float | None = None, loops: int = 1
    ) -> None:
        self._sequence, self._cameras, self._domain, self._loops = sequence, cameras, domain, loops
        count = len(sequence)
        if rate is not None:
            self._times = np.arange(count) / rate
        elif sequence.timestamps is None:
            raise SettingsError(f"{sequence.name} has no times. Give its images per second (--rate).")
        else:
            self._times = sequence.timestamps - sequence.timestamps[0]
        last_gap = self._times[-1] - self._times[-2] if count > 1 else 1.0
        self._length = float(self._times[-1] + last_gap)
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Moment]:
        """See `Source`."""
        began = time.monotonic()
        for loop in range(self._loops):
            for index, offset in enumerate(self._times):
                due = loop * self._length + float(offset)
                following = loop * self._length + float(np.append(self._times, self._length)[index + 1])
                if time.monotonic() - began > following:
                    continue  # Too late for it.
                frame = self._sequence.frame(index, self._domain, self._cameras)
                if self._closed.wait(max(0.0, due - (time.monotonic() - began))):
                    return
                yield Moment(replace(frame, timestamp=due))

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()


class Camera:
    """A camera or video that OpenCV opens; joints come from somewhere else.

    Args:
        assembler: knows the joints.
        camera: name of the camera in the scene.
        device: number of a device, or a file.

    Raises:
        SettingsError: it cannot be opened.
    """

    def __init__(self, assembler: Assembler, camera: str, device: int | str) -> None:
        self._assembler, self._camera = assembler, camera
        self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise SettingsError(
                f"OpenCV cannot open {device!r} as a camera or video. Give a device's number or a file."
            )
        # A device gives frames at its own pace, a file as fast as it is read.
        rate = self._capture.get(cv2.CAP_PROP_FPS) if isinstance(device, str) else 0.0
        self._gap = 1.0 / rate if rate > 0 else 0.0
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Moment]:
        """See `Source`."""
        began = due = time.monotonic()
        try:
            while not self._closed.wait(max(0.0, due - time.monotonic()) if self._gap else 0.0):
                fine, image = self._capture.read()
                if not fine:
                    return
                due += self._gap
                data = np.ascontiguousarray(image[..., ::-1])
                picture = ImageMessage(data.tobytes(), "rgb8", data.shape[1], data.shape[0])
                moment = self._assembler.moment(FrameMessage(time.monotonic() - began, images={self._camera: picture}))
                if moment is not None:
                    yield moment
        finally:
            self._capture.release()

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()


class Folder:
    """A folder that fills with `NAME.json` and an image `NAME.png`, or `NAME.CAMERA.png` of each of several cameras.

    The JSON file is a frame message without images. It is written last, so that a name counts once it is there; of
    several new names only the last counts. What cannot be used is left out, and a warning is logged.

    Args:
        assembler: makes frames of it.
        cameras: whose images are wanted.
        folder: the folder.

    Raises:
        SettingsError: it is no folder.
    """

    def __init__(self, assembler: Assembler, cameras: tuple[str, ...], folder: Path) -> None:
        if not folder.is_dir():
            raise SettingsError(f"{folder} is no folder. Name the one that images are written to.")
        self._assembler, self._cameras, self._folder = assembler, cameras, folder
        self._left_out = 0
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Moment]:
        """See `Source`."""
        seen = ""
        while not self._closed.wait(_POLL):
            newest = max((path.stem for path in self._folder.glob("*.json")), default="")
            if newest <= seen:
                continue
            seen = newest
            try:
                moment = self._assembler.moment(self._message(newest))
            except StreamError as error:
                self._leave_out(error)
                continue
            if moment is not None:
                yield moment

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()

    def _leave_out(self, error: StreamError) -> None:
        self._left_out += 1
        if self._left_out <= _NAMED:
            further = " Further ones are not named." if self._left_out == _NAMED else ""
            _log.warning("A frame is left out: %s%s", error, further)

    def _message(self, name: str) -> FrameMessage:
        path = self._folder / f"{name}.json"
        try:
            message = msgspec.json.decode(read_bytes(path, VALUES), type=FrameMessage)
        except (OSError, msgspec.MsgspecError, RecursionError) as error:
            raise StreamError(f"{path} cannot be read: {error}. docs/reference/live.md describes it.") from error
        images = {camera: self._image(name, camera) for camera in self._cameras}
        return msgspec.structs.replace(message, images=images, id=message.id or name)

    def _image(self, name: str, camera: str) -> ImageMessage:
        stems = [f"{name}.{camera}", *([name] if len(self._cameras) == 1 else [])]
        found = [path for stem in stems for suffix in _SUFFIXES if (path := self._folder / f"{stem}{suffix}").exists()]
        if not found:
            images = " or ".join(f"{stem}.png" for stem in stems)
            raise StreamError(f"{self._folder} has {name}.json and no image {images}. Write the JSON file last.")
        try:
            image = read_image(found[0])
        except SequenceError as error:
            raise StreamError(str(error)) from error
        return ImageMessage(image.tobytes(), "rgb8", image.shape[1], image.shape[0])
