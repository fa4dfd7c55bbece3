"""Sources of live streams: cameras, recordings, and a network server."""

import logging
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from ..errors import SequenceError, SettingsError
from ..files.reading import VALUES, read_bytes
from ..recording import Sequence
from ..recording.images import read_image
from ..settings.live import StreamAddress, StreamKind
from .messages import (
    Assembler,
    ErrorMessage,
    FrameMessage,
    ImageMessage,
    ResultMessage,
    Source,
    StreamError,
    StreamFrame,
    packed,
    receive,
)

HOST = "127.0.0.1"
_WAITING = 8
"""Maximum number of results waiting for a slow client; older results are dropped."""
_CLIENTS = 16
_SILENCE = 10.0
"""Idle time after which a client may be disconnected in favour of a new client if the maximum number of connections is
reached [s]."""
_LINGER = 1.0
"""Minimum time for which a client that sends receives results after closing its side of the connection [s]."""
_LONGEST_LINGER = 30.0
"""Maximum further time until the result of its last frame [s], which never comes if the frame was dropped."""


class _Client:
    """Client: queue of outgoing messages, time of the last received message [s], and last frame."""

    def __init__(self) -> None:
        self.waiting: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self.heard = time.monotonic()
        self.sends = False
        self.last: tuple[str, float | None] | None = None
        """Id and timestamp of the client's last frame."""
        self.answered = threading.Event()
        """Set unless the result of the last frame is missing."""
        self.answered.set()


class StreamServer:
    """Server on 127.0.0.1 that receives frames from clients and sends them the results.

    Args:
        assembler: assembler of messages.
        port: port number; 0 chooses a free port.

    Attributes:
        port: port number of the server.

    Raises:
        SettingsError: the port is in use.
    """

    def __init__(self, assembler: Assembler, port: int) -> None:
        self._assembler = assembler
        self._moments: queue.Queue[StreamFrame | None] = queue.Queue(2)
        self._clients: dict[socket.socket, _Client] = {}
        self._changing, self._closed = threading.Lock(), threading.Event()
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise SettingsError(
                f"port {port} of {HOST} cannot be used: {error}. Choose another port, or 0 for a free port."
            ) from error
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, name="carts-live-accept", daemon=True).start()

    def __iter__(self) -> Iterator[StreamFrame]:
        """See `Source`; only `close` ends the stream."""
        while (moment := self._moments.get()) is not None:
            yield moment

    def send(self, result: ResultMessage) -> None:
        """Send a result to all clients; slow clients miss results."""
        content = packed(result)
        with self._changing:
            for client in self._clients.values():
                _put_newest(client.waiting, content)
                if client.last == (result.id, result.time):
                    client.answered.set()

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._changing:
            for client in self._clients.values():
                _put_newest(client.waiting, None)
                client.answered.set()
        _put_newest(self._moments, None)
        # Clients that do not read their results would stay connected.
        timer = threading.Timer(_LINGER, self._disconnect)
        timer.daemon = True
        timer.start()

    def _disconnect(self) -> None:
        with self._changing:
            for connection in self._clients:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            client = _Client()
            with self._changing:
                full = not self._has_room()
                if not full:
                    self._clients[connection] = client
            if full:
                text = f"{_CLIENTS} clients are connected, which is the limit. Close a connection and try again."
                with connection, suppress(OSError):
                    connection.sendall(packed(ErrorMessage(text)))
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._read, args=(connection, client), daemon=True).start()
            threading.Thread(target=self._write, args=(connection, client), daemon=True).start()

    def _has_room(self) -> bool:
        """Whether another client may connect; the longest idle client is disconnected if necessary."""
        if len(self._clients) < _CLIENTS:
            return True
        connection, longest = min(self._clients.items(), key=lambda each: each[1].heard)
        if time.monotonic() - longest.heard < _SILENCE:
            return False
        self._clients.pop(connection)
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        _put_newest(longest.waiting, None)
        return True

    def _read(self, connection: socket.socket, client: _Client) -> None:
        try:
            while (message := receive(connection)) is not None and not self._closed.is_set():
                client.heard, client.sends = time.monotonic(), True
                moment = self._assembler.moment(message, client.heard)
                if moment is not None:
                    with self._changing:
                        client.last = moment.frame.frame_id, moment.frame.timestamp
                        client.answered.clear()
                    _put_newest(self._moments, moment)
            if client.sends and not self._closed.wait(_LINGER):
                client.answered.wait(_LONGEST_LINGER)
        except StreamError as error:
            _put_newest(client.waiting, packed(ErrorMessage(str(error))))
        except OSError:
            pass
        _put_newest(client.waiting, None)

    def _write(self, connection: socket.socket, client: _Client) -> None:
        with suppress(OSError):
            while (content := client.waiting.get()) is not None:
                connection.sendall(content)
        with self._changing:
            self._clients.pop(connection, None)
            client.answered.set()
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()


def _put_newest(waiting: queue.Queue, item: object) -> None:
    """Put an item into a queue; the oldest item of a full queue is dropped."""
    while True:
        try:
            waiting.put_nowait(item)
            return
        except queue.Full:
            with suppress(queue.Empty):
                waiting.get_nowait()


_log = logging.getLogger(__name__)

_NAMED = 20
"""Maximum number of unusable frames that are logged."""
_POLL = 0.01
"""Interval between listings of a folder [s]; at least the duration of a listing."""
_MESSAGE = ".json"
_SUFFIXES = (".png", ".jpg", ".jpeg")


class _Closable:
    """Source that ends when `close` is called."""

    def __init__(self) -> None:
        self._closed = threading.Event()

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()


class Replay(_Closable):
    """Real-time replay of a recording; late frames are skipped.

    Args:
        sequence: the recording.
        cameras: cameras to replay.
        domain: domain to replay.
        rate: frame rate [1/s]; None for the recorded frame rate.
        loops: number of passes through the recording; timestamps continue to increase.

    Raises:
        SettingsError: the recording has no timestamps, and no rate is given.
    """

    def __init__(
        self, sequence: Sequence, cameras: tuple[str, ...], domain: str, *, rate: float | None = None, loops: int = 1
    ) -> None:
        super().__init__()
        self._sequence, self._cameras, self._domain, self._loops = sequence, cameras, domain, loops
        count = len(sequence)
        if rate is not None:
            self._times = np.arange(count) / rate
        elif sequence.timestamps is None:
            raise SettingsError(f"{sequence.name} has no timestamps. Give its frame rate (--rate).")
        else:
            self._times = sequence.timestamps - sequence.timestamps[0]
        last_gap = self._times[-1] - self._times[-2] if count > 1 else 1.0
        self._length = float(self._times[-1] + last_gap)

    def __iter__(self) -> Iterator[StreamFrame]:
        """See `Source`."""
        began = time.monotonic()
        for loop in range(self._loops):
            for index, offset in enumerate(self._times):
                due = loop * self._length + float(offset)
                following = loop * self._length + float(np.append(self._times, self._length)[index + 1])
                if time.monotonic() - began > following:
                    continue  # The frame is late and is skipped.
                frame = self._sequence.frame(index, self._domain, self._cameras)
                if self._closed.wait(max(0.0, due - (time.monotonic() - began))):
                    return
                yield StreamFrame(replace(frame, timestamp=due))


class Camera(_Closable):
    """Camera device or video file read with OpenCV; joints come from another source.

    Args:
        assembler: assembler with the joints.
        camera: name of the camera in the scene.
        device: number of a device, or path of a video file.

    Raises:
        SettingsError: the device or file cannot be opened.
    """

    def __init__(self, assembler: Assembler, camera: str, device: int | str) -> None:
        super().__init__()
        self._assembler, self._camera = assembler, camera
        self._capture = cv2.VideoCapture(device)
        if not self._capture.isOpened():
            raise SettingsError(
                f"OpenCV cannot open {device!r} as a camera or video. Give a device number or a video file."
            )
        # A device has its own rate; a file is throttled to its frame rate.
        rate = self._capture.get(cv2.CAP_PROP_FPS) if isinstance(device, str) else 0.0
        self._gap = 1.0 / rate if rate > 0 else 0.0

    def __iter__(self) -> Iterator[StreamFrame]:
        """See `Source`."""
        began = due = time.monotonic()
        try:
            while not self._closed.wait(max(0.0, due - time.monotonic()) if self._gap else 0.0):
                fine, image = self._capture.read()
                if not fine:
                    return
                due, arrived = due + self._gap, time.monotonic()
                data = np.ascontiguousarray(image[..., ::-1])
                picture = ImageMessage(data.tobytes(), "rgb8", data.shape[1], data.shape[0])
                moment = self._assembler.moment(FrameMessage(arrived - began, images={self._camera: picture}), arrived)
                if moment is not None:
                    yield moment
        finally:
            self._capture.release()


class Folder(_Closable):
    """Watched folder with files `NAME.json` and `NAME.png`, or `NAME.CAMERA.png` for each of several cameras.

    The JSON file is a frame message without images and must be written last. Names must increase in
    alphabetical order; only the last of several new frames is read. Unusable frames are skipped with a warning.

    Args:
        assembler: assembler of the messages.
        cameras: cameras to read.
        folder: folder to watch.

    Raises:
        SettingsError: `folder` is not a folder.
    """

    def __init__(self, assembler: Assembler, cameras: tuple[str, ...], folder: Path) -> None:
        super().__init__()
        if not folder.is_dir():
            raise SettingsError(f"{folder} is not a folder. Give the folder to which images are written.")
        self._assembler, self._cameras, self._folder = assembler, cameras, folder
        self._left_out = 0

    def __iter__(self) -> Iterator[StreamFrame]:
        """See `Source`."""
        seen, pause = "", _POLL
        while not self._closed.wait(pause):
            began = time.monotonic()
            newest = self._newest()
            pause = max(_POLL, time.monotonic() - began)
            if newest <= seen:
                continue
            seen, arrived = newest, time.monotonic()
            try:
                moment = self._assembler.moment(self._message(newest), arrived)
            except StreamError as error:
                self._leave_out(error)
                continue
            if moment is not None:
                yield moment

    def _newest(self) -> str:
        """Last name of a message in alphabetical order, without suffix; empty if there is none."""
        try:
            names = os.listdir(self._folder)
        except OSError:  # The folder may be recreated.
            return ""
        return max((name[: -len(_MESSAGE)] for name in names if name.endswith(_MESSAGE)), default="")

    def _leave_out(self, error: StreamError) -> None:
        self._left_out += 1
        if self._left_out <= _NAMED:
            further = " Further frames are not reported." if self._left_out == _NAMED else ""
            _log.warning("A frame is skipped: %s%s", error, further)

    def _message(self, name: str) -> FrameMessage:
        path = self._folder / f"{name}{_MESSAGE}"
        try:
            message = msgspec.json.decode(read_bytes(path, VALUES), type=FrameMessage)
        except (OSError, msgspec.MsgspecError, RecursionError) as error:
            raise StreamError(
                f"{path} cannot be read: {error}. docs/reference/live.md describes the format."
            ) from error
        images = {camera: self._image(name, camera) for camera in self._cameras}
        return msgspec.structs.replace(message, images=images, id=message.id or name)

    def _image(self, name: str, camera: str) -> ImageMessage:
        stems = [f"{name}.{camera}", *([name] if len(self._cameras) == 1 else [])]
        found = [path for stem in stems for suffix in _SUFFIXES if (path := self._folder / f"{stem}{suffix}").exists()]
        if not found:
            images = " or ".join(f"{stem}.png" for stem in stems)
            raise StreamError(f"{self._folder} has {name}.json but no image {images}. Write the JSON file last.")
        try:
            image = read_image(found[0])
        except SequenceError as error:
            raise StreamError(str(error)) from error
        return ImageMessage(image.tobytes(), "rgb8", image.shape[1], image.shape[0])


@dataclass(frozen=True)
class OpenStream:
    """Source of frames, and its server if it has one."""

    source: Source
    server: StreamServer | None = None

    @property
    def clients(self) -> list[Callable[[ResultMessage], None]]:
        """Sinks that send results to network clients."""
        return [] if self.server is None else [self.server.send]

    def close(self) -> None:
        """Close source and server; can be called more than once."""
        self.source.close()
        if self.server is not None:
            self.server.close()


def open_stream(
    address: StreamAddress,
    sequence: Sequence,
    cameras: tuple[str, ...],
    domain: str,
    *,
    rate: float | None = None,
    loops: int = 1,
) -> OpenStream:
    """Open a stream of a sequence's arms and cameras.

    Args:
        address: address of the source.
        sequence: sequence with the arms and cameras.
        cameras: cameras that need an image in each frame; a device is the first camera.
        domain: domain of a replay.
        rate: frame rate of a replay [1/s]; as recorded if None.
        loops: number of passes of a replay through the recording.

    Raises:
        SettingsError: a device, a folder or a port cannot be used, or a replay has no timestamps.
    """
    if address.kind is StreamKind.REPLAY:
        return OpenStream(Replay(sequence, cameras, domain, rate=rate, loops=loops))
    assembler = Assembler(sequence, cameras)
    port = int(address.place) if address.kind is StreamKind.SOCKET else address.joints_port
    server = None if port is None else StreamServer(assembler, port)
    try:
        if server is not None and address.kind is StreamKind.SOCKET:
            return OpenStream(server, server)
        if address.kind is StreamKind.FOLDER:
            return OpenStream(Folder(assembler, cameras, Path(address.place)), server)
        device = int(address.place) if address.kind is StreamKind.CAMERA else address.place
        return OpenStream(Camera(assembler, cameras[0], device), server)
    except BaseException:
        if server is not None:
            server.close()
        raise
