"""A socket on this machine: senders' frames and joints come in, every client gets every result."""

import queue
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

from ..errors import SettingsError
from .messages import ErrorMessage, ResultMessage, StreamError, packed, receive
from .moments import Assembler, Moment

HOST = "127.0.0.1"
_WAITING = 8
"""Results that wait for a slow client; older ones are dropped."""
_CLIENTS = 16
_SILENCE = 10.0
"""Since a client's last message, after which it makes room for another client where all places are taken [s]."""
_LINGER = 1.0
"""For which a sender still gets results when it has ended its side [s]."""


class _Client:
    """One connection: what it is to be sent, and when it last sent a message [s]."""

    def __init__(self) -> None:
        self.waiting: queue.Queue[bytes | None] = queue.Queue(_WAITING)
        self.heard = time.monotonic()
        self.sends = False


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
        self._clients: dict[socket.socket, _Client] = {}
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
            for client in self._clients.values():
                _put_newest(client.waiting, content)

    def close(self) -> None:
        """See `Source`."""
        self._closed.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._changing:
            for client in self._clients.values():
                _put_newest(client.waiting, None)
        _put_newest(self._moments, None)

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
                _refuse(connection)
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._read, args=(connection, client), daemon=True).start()
            threading.Thread(target=self._write, args=(connection, client), daemon=True).start()

    def _has_room(self) -> bool:
        """Whether one more client can be taken, if need be in place of the one that has been silent for longest."""
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
                moment = self._assembler.moment(message)
                if moment is not None:
                    _put_newest(self._moments, moment)
            if client.sends:
                self._closed.wait(_LINGER)
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
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()


def _refuse(connection: socket.socket) -> None:
    """Close a connection for which there is no place."""
    with connection, suppress(OSError):
        connection.sendall(packed(ErrorMessage(f"{_CLIENTS} clients are connected. Close one, or try again.")))


def _put_newest(waiting: queue.Queue, item: object) -> None:
    """Put something in, in place of the oldest where there is no room."""
    while True:
        try:
            waiting.put_nowait(item)
            return
        except queue.Full:
            with suppress(queue.Empty):
                waiting.get_nowait()
