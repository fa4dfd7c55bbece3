"""Exceptions of the project.

Each message states what was given, what is allowed, and a remedy.
"""

from .wording import shortened

_LONGEST = 4000
"""Maximum length of a message, which may quote a file [characters]."""


class CartsError(Exception):
    """Base class of all errors with a message for the user."""

    def __str__(self) -> str:
        return shortened(super().__str__(), _LONGEST)


class RobotError(CartsError):
    """A URDF, one of its meshes or a joint name cannot be used."""


class SequenceError(CartsError):
    """A sequence file, or a file it refers to, cannot be used."""


class WeightsError(CartsError):
    """A weights file is missing, unreadable or belongs to another network."""


class SettingsError(CartsError):
    """A setting is out of range or contradicts another setting."""


class ProjectError(CartsError):
    """A project file cannot be opened or written, or an edit does not match the sequence."""


class OutputError(CartsError):
    """A file or folder cannot be written, or a name is not allowed in its path."""
