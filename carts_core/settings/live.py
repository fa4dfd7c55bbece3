"""Settings of live tracking, and names of streams such as `replay` or `socket:7000`."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from ..errors import SettingsError
from .ranges import Range, Ranged
from .stages import LIVE_SEARCH, WARM, WARM_WIDE, Stage


class StreamKind(StrEnum):
    """Source of frames."""

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

Seconds = Annotated[float, Range(0, 3600, "s")]
"""A duration [s]."""


@dataclass(frozen=True)
class StreamAddress:
    """Source of frames, and of joints if images have none."""

    kind: StreamKind
    place: str = ""
    """Number of a device, a file, a folder or a port."""
    joints_port: int | None = None
    """With a camera or video: port of 127.0.0.1 for joints and results."""

    @classmethod
    def parse(cls, text: str, joints_port: int | None = None) -> "StreamAddress":
        """The address that a person has written; `SettingsError` for unknown kinds and places, and missing joints."""
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
class LiveSettings(Ranged):
    """Stages of a tracker, and thresholds for lost arms."""

    small: tuple[Stage, ...] = WARM
    """Stages of a frame near its prediction."""
    full: tuple[Stage, ...] = WARM_WIDE
    """Stages after a bad fit of the small ones."""
    search: tuple[Stage, ...] = LIVE_SEARCH
    """Stages for lost arms; `small` follows."""
    bad_loss: Annotated[float, Range(1e-3, 10)] = 0.06
    """Loss from which a fit is bad [1]."""
    bad_factor: Annotated[float, Range(1, 100)] = 2.5
    """A fit of that many times the usual loss is bad, too [1]."""
    lost_seconds: Seconds = 0.25
    """After bad fits for so long, the arms are lost [s]."""
    search_seconds: Seconds = 0.4
    """Interval of searches for lost arms; frames between are compared with the last known pose [s]."""
    oldest_seconds: Seconds = 0.1
    """A frame whose result would be older, at the usual time for a frame, is dropped for the next one [s]."""
