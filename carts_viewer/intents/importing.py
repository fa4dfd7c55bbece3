"""Bringing in masks and keypoints of others."""

from dataclasses import dataclass

from carts_viewer.intents.base import Intent


@dataclass(frozen=True)
class ImportMasks(Intent):
    """Put masks and keypoints of a file or folder into the project, as one step."""

    place: str
    """Path of the file or folder; relative to the sequence's folder, or absolute in an allowed one."""
    camera: str | None = None
    """Whose images they are; None: as the names of files say."""
    replace: bool = False
    """Whether layers that were imported before may be replaced."""
