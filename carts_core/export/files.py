"""Files that are there whole or not at all, and names that are safe for them."""

import os
import re
from pathlib import Path

from ..errors import CartsError


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it, so that no half-written file bears the final name.

    Raises:
        CartsError: the folder cannot be written to.
    """
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        os.replace(part, path)
    except OSError as error:
        raise CartsError(f"{path} cannot be written ({error.strerror}). Name a folder you may write to.") from error


def file_name(text: str) -> str:
    """A name from a sequence file as part of a path that leads nowhere else; letters of any script stay."""
    return re.sub(r"[^\w.-]+", "_", text).lstrip(".") or "_"


def unique_file_names(texts: list[str]) -> list[str]:
    """`file_name` of each text, numbered where two would be the same file (also where case is ignored)."""
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
