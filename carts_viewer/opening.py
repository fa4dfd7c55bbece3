"""Opens the page in the default browser, without a token where other users of this computer could read it."""

import html
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from carts_core.files import write_text

_PAGE = '<!DOCTYPE html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={url}"><title>CaRTS</title>'


@contextmanager
def opened_in_browser(url: str) -> Iterator[None]:
    """Open a page; until the block ends, the file that leads there is kept.

    The command line of a browser can be read by everybody on this computer. So a url with a token is not put there but
    into a file in a folder that this user alone may look into, and the browser is given that file.
    """
    if "token=" not in url:
        webbrowser.open(url)
        yield
        return
    with TemporaryDirectory(prefix="carts-") as folder:
        page = Path(folder) / "open.html"
        write_text(page, _PAGE.format(url=html.escape(url)))
        page.chmod(0o600)
        webbrowser.open(page.as_uri())
        yield
