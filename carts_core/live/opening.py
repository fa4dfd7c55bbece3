"""Opening a live stream."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from ..recording import Sequence
from ..settings.live import StreamAddress, StreamKind
from .messages import ResultMessage
from .moments import Assembler, Source
from .server import StreamServer
from .sources import Camera, Folder, Replay


@dataclass(frozen=True)
class OpenStream:
    """A source, and a server where there is one, which is closed with it."""

    source: Source
    server: StreamServer | None = None

    @property
    def clients(self) -> list[Callable[[ResultMessage], None]]:
        """Where results go besides."""
        return [] if self.server is None else [self.server.send]

    def close(self) -> None:
        """End it; more than once does no harm."""
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
        address: where frames come from.
        sequence: whose arms and cameras these are.
        cameras: that every frame needs an image of; a device gives the first one's.
        domain: of a replay.
        rate: of a replay [1/s]; None: as recorded.
        loops: how often a replay is shown.

    Raises:
        SettingsError: a device, a folder or a port cannot be used, or a replay has no times.
    """
    if address.kind is StreamKind.REPLAY:
        return OpenStream(Replay(sequence, cameras, domain, rate=rate, loops=loops))
    assembler = Assembler(sequence, cameras)
    port = int(address.place) if address.kind is StreamKind.SOCKET else address.joints_port
    with ExitStack() as held:
        server = None if port is None else StreamServer(assembler, port)
        if server is not None:
            held.callback(server.close)
        match address.kind:
            case StreamKind.SOCKET:
                assert server is not None
                source: Source = server
            case StreamKind.FOLDER:
                source = Folder(assembler, cameras, Path(address.place))
            case StreamKind.CAMERA:
                source = Camera(assembler, cameras[0], int(address.place))
            case _:
                source = Camera(assembler, cameras[0], address.place)
        held.pop_all()
    return OpenStream(source, server)
