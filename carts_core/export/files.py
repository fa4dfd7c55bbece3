"""Files that are there whole or not at all."""

import os
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
