"""Names and paths of outputs, and opening of folders component by component without following links."""

import errno
import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from ..errors import OutputError

NAME_BYTES = 200
"""Maximum length of an untrusted name [bytes]; the remainder is reserved for additions such as `.png`."""
_FILE_BYTES = 255
"""Maximum length of a path component in file systems [bytes]."""
_REFUSED = re.compile(r"[/\\\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Path separators, control characters, line separators and surrogates."""


def home() -> Path:
    """The user's home folder; if there is none, the root folder, to which nothing is written."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/")


def name_fault(text: str, most_bytes: int = NAME_BYTES) -> str | None:
    """Reason why a string is not allowed as a file name, as a clause that follows "is 'TEXT', "; None if allowed.

    Letters of any script, spaces and most punctuation are allowed, but no paths, hidden names, control characters or
    overlong names.

    Args:
        text: an untrusted name of a sequence, frame, camera, domain or arm.
        most_bytes: maximum length in UTF-8.
    """
    if not text:
        return "which is empty"
    if text.startswith("."):
        return "which starts with a dot"
    if found := _REFUSED.search(text):
        what = f"the path separator {found[0]!r}" if found[0] in "/\\" else f"the control character {found[0]!r}"
        return f"which contains {what}"
    if (length := len(text.encode())) > most_bytes:
        return f"which is {length} bytes long"
    return None


def allowed_names(most_bytes: int = NAME_BYTES) -> str:
    """Description of the names allowed by `name_fault`, for error messages."""
    return (
        f"Names are used in file names, so they must have 1 to {most_bytes} bytes, and no / or \\, control characters "
        "or leading dot. Rename it"
    )


def check_name(text: str, what: str, most_bytes: int = NAME_BYTES) -> str:
    """Return the name; `OutputError` unless it is a single safe path component."""
    if fault := name_fault(text, most_bytes):
        shown = text if len(text) <= _FILE_BYTES else f"{text[:60]}…"
        raise OutputError(f"the name of {what} is {shown!r}, {fault}. {allowed_names(most_bytes)}.")
    return text


@dataclass(frozen=True)
class OutputPath(os.PathLike[str]):
    """File or folder to write, created by `output_path` and `/`, which check every name.

    Links are followed on the path to `folder`, which is given by the user, but not below `folder`.
    """

    folder: Path
    """Folder given by the user, which need not exist."""
    names: tuple[str, ...] = ()
    """Path components below `folder`."""
    draft: bool = False
    """Whether the path is in an unpublished folder, whose files are written once and synchronized together."""

    def __truediv__(self, name: str) -> "OutputPath":
        check_name(name, f"a file or folder in {self.path}", _FILE_BYTES)
        return replace(self, names=(*self.names, name))

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)

    @property
    def path(self) -> Path:
        """Path for reading and for messages."""
        return self.folder.joinpath(*self.names)

    @property
    def name(self) -> str:
        """Last component."""
        return self.path.name

    @property
    def parent(self) -> "OutputPath":
        """Parent folder."""
        if self.names:
            return replace(self, names=self.names[:-1])
        return replace(self, folder=self.folder.parent)


def output_path(folder: Path, *names: str, draft: bool = False) -> OutputPath:
    """Create the path of a file or folder to write; all such paths are created here.

    Args:
        folder: folder given by the user on the command line or in the environment, never by a recording.
        names: components below `folder`, which may be untrusted; `OutputError` unless each is a single name.
    """
    path = OutputPath(folder, draft=draft)
    for name in names:
        path = path / name
    return path


def as_output(path: OutputPath | Path) -> OutputPath:
    """Convert a path to an output path whose last component is not followed if it is a link."""
    if isinstance(path, OutputPath) and path.names:
        return path
    draft = isinstance(path, OutputPath) and path.draft
    whole = Path(os.path.abspath(path))
    return OutputPath(whole.parent, (whole.name,), draft)


def file_name(text: str) -> str:
    """Convert an untrusted string to a valid file name; letters of any script are kept."""
    name = re.sub(r"[^\w.-]+", "_", text).lstrip(".")
    return name.encode(errors="ignore")[:NAME_BYTES].decode(errors="ignore") or "_"


def unique_file_names(texts: list[str]) -> list[str]:
    """`file_name` of each string, with numbers if names would collide (also if case is ignored)."""
    names: list[str] = []
    taken: set[str] = set()
    for text in texts:
        name = stem = file_name(text)
        number = 1
        while name.casefold() in taken:
            number += 1
            name = f"{stem}-{number}"
        taken.add(name.casefold())
        names.append(name)
    return names


def resolved_paths(paths: Iterable[str | Path]) -> list[str]:
    """Absolute paths without links, as by `Path.resolve`; folders that the paths share are resolved once."""

    @cache
    def resolved(folder: str) -> str:
        return below(*folder.rsplit("/", 1)) if folder else ""

    def below(folder: str, name: str) -> str:
        path = f"{resolved(folder)}/{name}"
        return os.path.realpath(path) if name in ("", ".", "..") or os.path.islink(path) else path

    here = os.getcwd()
    whole = (path if path.startswith("/") else f"{here}/{path}" for path in map(str, paths))
    return [below(*path.rsplit("/", 1)) for path in whole]


_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC


@contextmanager
def explained(path: object) -> Iterator[None]:
    """Convert errors of the operating system to `OutputError`."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({error.strerror or error}). Nothing was changed there. Free disk space, or "
            "choose a writable folder."
        ) from error


@contextmanager
def opened_folder(path: OutputPath, *, make: bool = False) -> Iterator[int]:
    """Open the folder at `path`; yields its descriptor.

    Args:
        path: path of the folder; links are followed only up to `path.folder`.
        make: create missing folders.

    Raises:
        OutputError: a component below `path.folder` is a link or not a folder.
        OSError: the folder does not exist or cannot be opened.
    """
    if make:
        _make(path.folder.absolute())
    descriptor = os.open(path.folder, _FOLDER)
    try:
        for number, name in enumerate(path.names, start=1):
            below = _step(descriptor, name, path.folder.joinpath(*path.names[:number]), make)
            os.close(descriptor)
            descriptor = below
        yield descriptor
    finally:
        os.close(descriptor)


def open_below(folder: int, name: str) -> int:
    """Open the subfolder `name` of an open folder and return its descriptor; `OSError` if it is missing, a link, or not
    a folder.
    """
    return os.open(name, _FOLDER | os.O_NOFOLLOW, dir_fd=folder)


def status(folder: int, name: str) -> os.stat_result | None:
    """Status of the entry `name` in an open folder, without following links; None if it does not exist."""
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None


def kind_of(found: os.stat_result) -> str:
    """Kind of an entry, as a noun."""
    names = {stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFREG: "a file", stat.S_IFIFO: "a pipe"}
    return names.get(stat.S_IFMT(found.st_mode), "a device or socket")


def _step(folder: int, name: str, path: Path, make: bool) -> int:
    if make:
        with suppress(FileExistsError):
            os.mkdir(name, dir_fd=folder)
            os.fsync(folder)
    try:
        return open_below(folder, name)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENOTDIR):
            raise
        found = status(folder, name)
        raise OutputError(
            f"{path} is {kind_of(found) if found else 'missing'}, but must be a folder; links are never followed when "
            "writing. Nothing was changed there. Remove it, or choose another output."
        ) from error


def _make(folder: Path) -> None:
    """Create a folder and its missing parents, and synchronize them to disk."""
    if folder.is_dir():
        return
    _make(folder.parent)
    with suppress(FileExistsError):
        os.mkdir(folder)
        descriptor = os.open(folder.parent, _FOLDER)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
