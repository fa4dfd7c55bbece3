"""A socket on this machine: senders' frames and joints come in, every client gets every result."""

import queue
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress

from ..errors import SettingsError
from .messages import ErrorMessage, ResultMessage, StreamError, packed, receive
from .moments import Assembler, Moment

HOST = "127.0.0.1"
_WAITING = 8
"""Results that wait for a slow client; older ones are dropped."""
_CLIENTS = 16


class StreamServer:
    """Listens on 127.0.0.1; a source of frames, and where results go.

    Args:
        assembler: makes frames of messages.
        port: 0 takes a free one.

    Attributes:
        port: where it listens.

    Raises:
        SettingsError: the port is taken.
    """

    def __init__(self, assembler: Assembler, port: int) -> None:
        self._assembler = assembler
        self._moments: queue.Queue[Moment | None] = queue.Queue(2)
        self._clients: dict[socket.socket, queue.Queue[bytes | None]] = {}
        self._changing, self._closed = threading.Lock(), threading.Event()
        try:
            self._listener = socket.create_server((HOST, port))
        except OSError as error:
            raise SettingsError(f"port {port} of {HOST} cannot be used: {error}. Give another, or 0.") from error
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, name="carts-live-accept", daemon=True).start()

    def __iter__(self) -> Iterator[Moment]:
        """See `Source`; the stream ends with `close` only."""
        while (moment := self._moments.get()) is not None:
            yield moment

    def send(self, result: ResultMessage) -> None:
        """Hand a result to every client; who reads too slowly misses some."""
        content = packed(result)
        with self._changing:
            for waiting in self._clients.values():
                _put_newest(waiting, content)

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._changing:
            for waiting in self._clients.values():
                _put_newest(waiting, None)
        _put_newest(self._moments, None)

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with self._changing:
                if len(self._clients) >= _CLIENTS:
                    connection.close()
                    continue
                waiting = self._clients[connection] = queue.Queue(_WAITING)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._read, args=(connection, waiting), daemon=True).start()
            threading.Thread(target=self._write, args=(connection, waiting), daemon=True).start()

    def _read(self, connection: socket.socket, waiting: "queue.Queue[bytes | None]") -> None:
        try:
            while (message := receive(connection)) is not None and not self._closed.is_set():
                moment = self._assembler.moment(message)
                if moment is not None:
                    _put_newest(self._moments, moment)
        except StreamError as error:
            _put_newest(waiting, packed(ErrorMessage(str(error))))
            _put_newest(waiting, None)
        except OSError:
            _put_newest(waiting, None)

    def _write(self, connection: socket.socket, waiting: "queue.Queue[bytes | None]") -> None:
        """Send what waits; a client that has ended its side still gets results."""
        with suppress(OSError):
            while (content := waiting.get()) is not None:
                connection.sendall(content)
        with self._changing:
            self._clients.pop(connection, None)
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()


def _put_newest(waiting: queue.Queue, item: object) -> None:
    """Put something in, in place of the oldest where there is no room."""
    while True:
        try:
            waiting.put_nowait(item)
            return
        except queue.Full:
            with suppress(queue.Empty):
                waiting.get_nowait()
