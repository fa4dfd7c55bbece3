"""What a live stream is called, as `replay` or `socket:7000`."""

from dataclasses import dataclass
from enum import StrEnum

from ..errors import SettingsError


class StreamKind(StrEnum):
    """Where frames come from."""

    REPLAY = "replay"
    """The recording itself, at the speed of the clock."""
    CAMERA = "camera"
    VIDEO = "video"
    FOLDER = "folder"
    """One that fills."""
    SOCKET = "socket"
    """Of 127.0.0.1."""


KNOWN = "replay, camera:NUMBER, video:FILE, folder:PATH or socket:PORT"
_PORTS = 2**16


@dataclass(frozen=True)
class StreamAddress:
    """Where frames come from, and joints where images have none."""

    kind: StreamKind
    place: str = ""
    """Number of a device, a file, a folder or a port."""
    joints_port: int | None = None
    """With a camera or video: port of 127.0.0.1 where joints come from, and where results go."""

    @classmethod
    def parse(cls, text: str, joints_port: int | None = None) -> "StreamAddress":
        """The address that a person has written.

        Raises:
            SettingsError: there is no such kind, its place does not fit, or joints are missing.
        """
        kind, _, place = text.partition(":")
        fits = {
            "replay": not place,
            "camera": place.isdecimal(),
            "video": bool(place),
            "folder": bool(place),
            "socket": place.isdecimal() and int(place) < _PORTS,
        }
        if not fits.get(kind, False):
            raise SettingsError(f"--source {text!r} is not known. Give {KNOWN}.")
        if joints_port is not None and not 0 <= joints_port < _PORTS:
            raise SettingsError(f"--joints-port is {joints_port}; allowed is 0 to {_PORTS - 1}.")
        address = cls(StreamKind(kind), place, joints_port)
        if address.kind in (StreamKind.CAMERA, StreamKind.VIDEO) and joints_port is None:
            raise SettingsError(f"--source {text} has no joints. Say with --joints-port on which port they come.")
        return address

    def __str__(self) -> str:
        return f"{self.kind}:{self.place}" if self.place else str(self.kind)
