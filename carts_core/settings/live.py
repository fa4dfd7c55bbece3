"""Settings of live tracking, and addresses of streams such as `replay` or `socket:7000`."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from ..errors import SettingsError
from .ranges import Range, Ranged
from .stages import LIVE_SEARCH, SETTLE, SIGHT, WARM, WARM_WIDE, Stage


class StreamKind(StrEnum):
    """Kind of frame source."""

    REPLAY = "replay"
    """Replay of the recording in real time."""
    CAMERA = "camera"
    VIDEO = "video"
    FOLDER = "folder"
    """Folder to which images are added."""
    SOCKET = "socket"
    """Socket on 127.0.0.1."""


KNOWN = "replay, camera:NUMBER, video:FILE, folder:PATH or socket:PORT"
_PORTS = 2**16
CURRENT = 2.0
"""Maximum age of a current result [frame intervals]."""

Seconds = Annotated[float, Range(0, 3600, "s")]
"""Duration [s]."""


@dataclass(frozen=True)
class StreamAddress:
    """Source of frames, and of joints if the frames contain none."""

    kind: StreamKind
    place: str = ""
    """Device number, file, folder or port."""
    joints_port: int | None = None
    """Port on 127.0.0.1 for joints and results: required for a camera or video, optional for a folder."""

    @classmethod
    def parse(cls, text: str, joints_port: int | None = None) -> "StreamAddress":
        """Parse an address; `SettingsError` for unknown kinds and locations, and for a missing joints port."""
        kind, _, place = text.partition(":")
        fits = {
            "replay": not place,
            "camera": place.isdecimal(),
            "video": bool(place),
            "folder": bool(place),
            "socket": place.isdecimal() and int(place) < _PORTS,
        }
        if not fits.get(kind, False):
            raise SettingsError(f"--source {text!r} is unknown. Give {KNOWN}.")
        if joints_port is not None and not 0 <= joints_port < _PORTS:
            raise SettingsError(f"--joints-port is {joints_port}; allowed: 0 to {_PORTS - 1}.")
        address = cls(StreamKind(kind), place, joints_port)
        if address.kind in (StreamKind.CAMERA, StreamKind.VIDEO) and joints_port is None:
            raise SettingsError(f"--source {text} has no joints. Give the port that receives them with --joints-port.")
        return address

    def __str__(self) -> str:
        return f"{self.kind}:{self.place}" if self.place else str(self.kind)


@dataclass(frozen=True)
class LiveSettings(Ranged):
    """Stages of a tracker, and thresholds for lost arms."""

    small: tuple[Stage, ...] = WARM
    """Stages for a frame whose state is near its prediction."""
    full: tuple[Stage, ...] = WARM_WIDE
    """Stages after a bad fit with `small`."""
    search: tuple[Stage, ...] = LIVE_SEARCH
    """Stages for lost arms."""
    settle: tuple[Stage, ...] = SETTLE
    """Stages for the frames after a search."""
    settle_frames: Annotated[int, Range(0, 100)] = 3
    """Number of frames after a search that are measured with `settle` [1]."""
    jump: Annotated[float, Range(1, 100)] = 2.5
    """Standard deviation of the error under which lost arms are searched, relative to that of the error model [1]. It
    is kept if the result is more likely under it."""
    sight: tuple[Stage, ...] = SIGHT
    """Observation that decides whether an image shows arms."""
    min_visible: Annotated[float, Range(0, 1)] = 0.25
    """Predicted area of arms, relative to the expected area, below which an image does not show them [1]; at most 0.03
    in synthetic images of 40 occluders, and at least 0.62 in images of arms 5 degrees off."""
    bad_loss: Annotated[float, Range(1e-3, 10)] = 0.06
    """Loss above which a fit is bad [1]."""
    sure_loss: Annotated[float, Range(1e-3, 10)] = 0.03
    """Loss of a search above which it is repeated with other random states [1]; at most 0.038 in correct results, at
    least 0.024 in wrong ones, so not all of these are recognized."""
    bad_factor: Annotated[float, Range(1, 100)] = 2.5
    """Multiple of the usual loss above which a fit is also bad [1]; this bound is at least half of `bad_loss`."""
    lost_seconds: Seconds = 0.25
    """Duration of at least two consecutive bad fits after which the arms are lost [s]."""
    search_seconds: Seconds = 0.4
    """Interval between searches for lost arms while images show them; frames in between are compared with the last
    known pose [s]. The first image that shows them again is searched at once."""
    blind_seconds: Seconds = 5.0
    """The same interval while no arm is predicted in the images [s]."""
    oldest_seconds: Seconds = 0.1
    """Maximum age of a result, without the usual time for decoding [s]; a frame whose result is expected to be older is
    dropped if another frame arrives within 0.5 s, which is then tracked whatever its age."""
