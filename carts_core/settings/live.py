"""Settings of live tracking, and names of streams such as `replay` or `socket:7000`."""

from dataclasses import dataclass
from enum import StrEnum

from ..errors import SettingsError
from .stages import LIVE_SEARCH, WARM, WARM_WIDE, Stage, require


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


@dataclass(frozen=True)
class LiveSettings:
    """What a tracker does with each frame, and when it takes the arms for lost."""

    small: tuple[Stage, ...] = WARM
    """Stages of a frame that is where it is expected."""
    full: tuple[Stage, ...] = WARM_WIDE
    """Stages where the small ones end in a bad fit."""
    search: tuple[Stage, ...] = LIVE_SEARCH
    """Stages where the arms are lost; `small` follows."""
    bad_loss: float = 0.06
    """Loss from which a fit is bad [1]."""
    bad_factor: float = 2.5
    """A fit of that many times the usual loss is bad, too [1]."""
    lost_seconds: float = 0.25
    """After bad fits for so long, the arms are lost [s]."""
    search_seconds: float = 0.4
    """Lost arms are searched for this often; frames between are compared with where they were last seen [s]."""
    oldest_seconds: float = 0.1
    """A frame whose result would be older, at the usual time for a frame, is dropped for the next one [s]."""

    def __post_init__(self) -> None:
        require(1e-3 <= self.bad_loss <= 10, "bad_loss", self.bad_loss, "0.001 to 10")
        require(1 <= self.bad_factor <= 100, "bad_factor", self.bad_factor, "1 to 100")
        for name in ("lost_seconds", "search_seconds", "oldest_seconds"):
            require(0 <= getattr(self, name) <= 3600, name, getattr(self, name), "0 to 3600 s")
