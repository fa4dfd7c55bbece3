"""From a path of any kind to a sequence file."""

from pathlib import Path

from ...errors import SequenceError
from ...settings.importing import ImportOptions
from ...wording import shown
from ..sources import SOURCES, Source
from .found import FoundRecording
from .placing import completed
from .writing import write_sequence


def detect(path: Path, name: str | None = None) -> Source:
    """The kind of a recording.

    Args:
        path: file or folder.
        name: of the kind, to skip the detection.

    Raises:
        SequenceError: nothing is there, or it is of no known kind.
    """
    kinds = "\n".join(f"  {source.name}: {source.label} ({source.looked_for})" for source in SOURCES)
    if not path.exists():
        raise SequenceError(f"{path} is missing. Give the file or folder of a recording.")
    if name is not None:
        for source in SOURCES:
            if source.name == name:
                return source
        raise SequenceError(f"--source {name!r} is not known. Known are:\n{kinds}")
    for source in SOURCES:
        if source.detect(path):
            return source
    raise SequenceError(f"{path} is no recording of a known kind. Looked for, in this order:\n{kinds}")


def find(path: Path, options: ImportOptions | None = None) -> FoundRecording:
    """What a recording holds, with stand-ins for what it lacks; nothing is written.

    Raises:
        CartsError: it is of no known kind, damaged, or contradicts itself.
    """
    options = options or ImportOptions()
    try:
        return completed(detect(path, options.source).read(path.absolute(), options))
    except OSError as error:
        named = "" if error.filename is None else f" {shown(str(error.filename))}"
        raise SequenceError(
            f"{path} cannot be read:{named} {error.strerror or error}. Check that it was copied whole, and its rights."
        ) from error


def import_recording(
    path: Path, folder: Path, options: ImportOptions | None = None, *, overwrite: bool = False
) -> tuple[Path, FoundRecording]:
    """Write a sequence file for a recording, which stays where it is.

    Args:
        path: file or folder of the recording.
        folder: to make; it holds sequence.toml and small tables.
        options: what the recording does not say.
        overwrite: replace an earlier import.

    Returns:
        The sequence file, and what was found.

    Raises:
        CartsError: it is of no known kind, damaged, or contradicts itself; nothing is written then.
    """
    recording = find(path, options)
    return write_sequence(recording, folder, overwrite=overwrite), recording
