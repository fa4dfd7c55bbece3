"""Following a live stream in the place of the recording."""

from dataclasses import dataclass

from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class Live(Intent):
    """An intent about live streams."""


@dataclass(frozen=True)
class StartLive(Live):
    """Show a stream, with the arms followed through it."""

    source: str
    """As `carts live --source`: `replay`, `socket:PORT` or `camera:NUMBER`."""
    joints_port: int | None = None
    """With a camera: port of 127.0.0.1 where joints come from."""
    repeat: bool = False
    """Whether a replay begins again when it ends."""
    rate: float | None = None
    """Frames per second of a replay; those of the recording's times if None."""
    record: bool = False
    """Whether what is seen is kept as a recording with its corrections."""


@dataclass(frozen=True)
class StopLive(Live):
    """Show the recording again."""
