"""Files to take away."""

from dataclasses import dataclass

from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class Exporting(Intent):
    """An intent about files to take away."""


@dataclass(frozen=True)
class ExportMask(Exporting):
    """Send this frame's mask, as a PNG, to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class ExportAll(Exporting):
    """Send all masks and the kinematics, as a zip, to the tab that asked."""

    client_id: int


@dataclass(frozen=True)
class CancelExport(Exporting):
    """Stop the export that is going on."""
