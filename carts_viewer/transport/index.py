"""The page that viser ships, into which ours is put."""

import functools
from pathlib import Path

import viser

from carts_core.errors import CartsError

TITLE = "<title>Viser</title>"
"""What is replaced in it."""


@functools.cache
def index_of_viser() -> str:
    """Its HTML.

    Raises:
        CartsError: another version of viser is installed.
    """
    index = Path(viser.__file__).parent / "client" / "build" / "index.html"
    text = index.read_text(encoding="utf-8")
    if TITLE not in text:
        raise CartsError(
            f"{index} is not the page of viser 1.1. Install the pinned version: pip install 'viser~=1.1.1'"
        )
    return text
