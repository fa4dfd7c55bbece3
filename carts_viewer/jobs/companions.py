"""Files beside a recording: decisions of the user on their content, and handling of damaged files.

Recordings are shared and copied, so their files may be from another user. Each decision is a file in `decisions/`
of the user's data folder, named by the SHA-256 digest of the content that was accepted or refused.
"""

from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from carts_core.errors import CartsError
from carts_core.files import OutputPath, output_path, remove_file, set_aside, write_text
from carts_core.files.reading import Kind, read_text
from carts_core.project.identity import data_dir

_FILE = Kind("decision", 64)
_MAX_CAUSE = 300
"""Maximum length of a quoted cause [characters]."""
_ACCEPTED, _REFUSED = "accepted", "refused"


class Decisions:
    """Decisions of this user on file contents; kept only in memory if the data folder is not writable."""

    def __init__(self) -> None:
        self._made: dict[str, bool] = {}

    def find(self, content: bytes) -> bool | None:
        """Whether content was accepted; None if undecided."""
        digest = _digest(content)
        if digest in self._made:
            return self._made[digest]
        try:
            return {_ACCEPTED: True, _REFUSED: False}.get(read_text(_path(digest).path, _FILE))
        except (OSError, ValueError):
            return None

    def make(self, content: bytes, accepted: bool) -> None:
        """Record the acceptance or refusal of content."""
        digest = _digest(content)
        self._made[digest] = accepted
        with suppress(CartsError):
            write_text(_path(digest), _ACCEPTED if accepted else _REFUSED)

    def forget(self, content: bytes) -> None:
        """Remove a decision."""
        digest = _digest(content)
        self._made.pop(digest, None)
        with suppress(CartsError):
            remove_file(_path(digest))


def _digest(content: bytes) -> str:
    return sha256(content).hexdigest()


def _path(digest: str) -> OutputPath:
    return output_path(data_dir(), "decisions", digest)


def set_aside_damaged(path: Path, what: str, error: Exception, effect: str, *, writable: bool = True) -> str:
    """Set a damaged file aside, and describe the damage.

    Args:
        path: the damaged file.
        what: kind of file, such as "list of jobs".
        error: reason why the file cannot be read.
        effect: consequence for the user, as a sentence without full stop.
        writable: whether the file may be renamed.

    Returns:
        Cause, effect and new name, as text for the user.
    """
    kept = "The file was not changed"
    if writable:
        try:
            kept = f"The damaged file is kept as {set_aside(path).name}"
        except CartsError as failed:
            kept = f"The damaged file could not be renamed: {failed}"
    return f"The {what} {path.name} cannot be read: {str(error)[:_MAX_CAUSE]}. {effect}. {kept}."
