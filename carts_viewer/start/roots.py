"""Folders that the user has allowed the page to read."""

import os
import stat
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from carts_core.errors import SettingsError

MAX_ENTRIES = 2000
"""Maximum number of listed entries of a folder."""


@dataclass(frozen=True)
class Entry:
    """A folder or file in a listing."""

    name: str
    path: Path
    is_folder: bool

    @property
    def about(self) -> str:
        """Size and modification date, as text; empty if they cannot be read."""
        try:
            known = os.lstat(self.path)
        except OSError:
            return ""
        size, unit = float(known.st_size), "B"
        for unit in ("B", "KB", "MB", "GB"):
            if size < 1000 or unit == "GB":
                break
            size /= 1000
        day = time.strftime("%Y-%m-%d", time.localtime(known.st_mtime))
        return f"{size:.{0 if unit in ('B', 'KB') else 1}f} {unit} · {day}"


class Roots:
    """Allowed folders; links are not followed, so nothing outside can be reached.

    Attributes:
        folders: the folders, resolved, in the order of `--root`.
        given: the absolute paths by which the folders were given, which may contain links; deepest first.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        """
        Args:
            folders: at least one existing folder.

        Raises:
            SettingsError: a folder does not exist.
        """
        for folder in folders:
            if not folder.is_dir():
                raise SettingsError(f"--root {folder} is not a folder. Give folders that contain recordings.")
        # An allowed folder may itself be a link; links below it are not followed.
        self.given = tuple(sorted((folder.absolute() for folder in folders), key=lambda each: -len(each.parts)))
        self.folders = tuple(dict.fromkeys(folder.resolve() for folder in folders))

    def checked(self, text: str | Path) -> Path:
        """Check an absolute path below one of the folders; returns it below the resolved folder.

        Raises:
            SettingsError: the path is relative or outside of the folders, does not exist, contains a link or a hidden
                name, or is neither a folder nor a file.
        """
        path = Path(text)
        if not path.is_absolute():
            raise SettingsError(f"{str(text)!r} is not an absolute path. Give a path such as {self.folders[0]}/NAME.")
        given = next((given for given in self.given if path.is_relative_to(given)), None)
        path = path if given is None else given.resolve() / path.relative_to(given)
        root = next((root for root in self.folders if path == root or path.is_relative_to(root)), None)
        if "\x00" in str(text) or ".." in path.parts or root is None:
            raise SettingsError(
                f"{text} is outside of the allowed folders. Restart carts view with --root FOLDER to allow it."
            )
        step = root
        try:
            for part in path.relative_to(root).parts:
                step = step / part
                if part.startswith("."):
                    raise SettingsError(
                        f"{step} is hidden. Choose another folder, or restart carts view with --root {step}."
                    )
                mode = os.lstat(step).st_mode
                if stat.S_ISLNK(mode):
                    raise SettingsError(f"{step} is a link, and links are not followed. Choose the folder itself.")
                if not (stat.S_ISDIR(mode) or stat.S_ISREG(mode)):
                    raise SettingsError(f"{step} is neither a folder nor a file. Choose another path.")
        except OSError as error:
            raise SettingsError(f"{step} cannot be opened ({error.strerror}). Choose another path.") from error
        return path

    def entries(self, folder: Path, wanted: Callable[[Entry], bool] = lambda _: True) -> list[Entry]:
        """Folders and then files, sorted by name, without hidden entries and links.

        Of more than `MAX_ENTRIES`, folders and wanted files are kept first.

        Raises:
            SettingsError: the folder is not allowed, or not readable.
        """

        def order(entry: Entry) -> tuple[bool, str]:
            return not entry.is_folder, entry.name.casefold()

        found = []
        try:
            with os.scandir(self.checked(folder)) as listing:
                for each in listing:
                    if each.name.startswith("."):
                        continue
                    is_folder = each.is_dir(follow_symlinks=False)
                    if is_folder or each.is_file(follow_symlinks=False):
                        found.append(Entry(each.name, Path(folder) / each.name, is_folder))
        except OSError as error:
            raise SettingsError(f"{folder} cannot be opened ({error.strerror}). Choose another path.") from error
        found.sort(key=lambda entry: (not (entry.is_folder or wanted(entry)), *order(entry)))
        return sorted(found[:MAX_ENTRIES], key=order)

    def parent(self, folder: Path) -> Path | None:
        """The folder above; None for an allowed folder itself."""
        return None if folder in self.folders else folder.parent
