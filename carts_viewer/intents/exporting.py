"""Files to take away."""

from dataclasses import dataclass

from carts_core.export import FormatName, Parts
from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class Exporting(Intent):
    """An intent about files to take away."""


@dataclass(frozen=True)
class ExportMask(Intent):
    """Send this frame's mask, as a PNG, to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class Export(Exporting):
    """Write frames in a format into a new folder or file beside the project."""

    format: FormatName
    frames: str
    """Which ones, one of `exporting.FRAME_CHOICES`."""
    parts: Parts = "arms"
    """What gets a category of its own."""
    images: bool = False
    """Copy the images beside their labels; otherwise labels name those of the recording, where the format allows it."""
    shown_camera: bool = False
    """Only the camera that is shown, not all."""
    range: tuple[int, int] | None = None
    """First and last frame, both exported; None for the whole sequence."""


@dataclass(frozen=True)
class CancelExport(Exporting):
    """Stop the export that is going on; nothing of it is left."""


@dataclass(frozen=True)
class Download(Exporting):
    """Send what was exported last to the tab that asked."""

    client_id: int
