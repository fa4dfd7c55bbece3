"""An export as one file, for the browser to save."""

import io
import zipfile
from pathlib import Path

from carts_core.errors import CartsError

LARGEST = 512 * 2**20
"""What may pass through the page's memory [bytes]."""
_COMPRESSED = {".png", ".jpg", ".mp4", ".npz"}


def zipped(path: Path) -> tuple[str, bytes]:
    """Name and content of a download: a file as it is, a folder as a zip with the folder in it.

    Raises:
        CartsError: it is gone, or too large for a browser.
    """
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    if not files:
        raise CartsError(f"{path} is not there any more. Export again.")
    size = sum(file.stat().st_size for file in files)
    if size > LARGEST:
        raise CartsError(
            f"{path} has {size / 2**20:.0f} MiB, more than the {LARGEST // 2**20} MiB that can be downloaded. "
            "Copy it from there."
        )
    if path.is_file():
        return path.name, path.read_bytes()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            kind = zipfile.ZIP_STORED if file.suffix in _COMPRESSED else zipfile.ZIP_DEFLATED
            archive.write(file, Path(path.name) / file.relative_to(path), kind)
    return f"{path.name}.zip", content.getvalue()
