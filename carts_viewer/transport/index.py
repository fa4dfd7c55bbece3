"""The page that viser ships, into which ours is put."""

import functools
from pathlib import Path

import viser

from carts_core.errors import CartsError

_TITLE, _LOADER, _CLIENT = "<title>Viser</title>", "<script data-p=", 'e.type="module";'
"""What is replaced in it: its title, the script that unpacks the client, and there the client's own element."""


def index_of_viser(head: str, nonce: str) -> str:
    """HTML of viser's page.

    Args:
        head: HTML in place of its title.
        nonce: Of the `Content-Security-Policy`, for its inline scripts.

    Raises:
        CartsError: another version of viser is installed.
    """
    before, after = _parts()
    return before + head + after.replace(_LOADER, f'<script nonce="{nonce}" data-p=', 1)


@functools.cache
def _parts() -> tuple[str, str]:
    """Of the page, before and after its title."""
    index = Path(viser.__file__).parent / "client" / "build" / "index.html"
    text = index.read_text(encoding="utf-8")
    if any(text.count(part) != 1 for part in (_TITLE, _LOADER, _CLIENT)):
        raise CartsError(
            f"{index} is not the page of viser 1.1. Install the pinned version: pip install 'viser~=1.1.1'"
        )
    # The client's own script element gets the nonce of the one that unpacks it.
    text = text.replace(_CLIENT, f'{_CLIENT}e.nonce=document.querySelector("script[data-p]").nonce;')
    before, _, after = text.partition(_TITLE)
    return before, after
