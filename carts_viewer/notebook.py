"""The viewer in a cell of a notebook."""

import html
import os
from pathlib import Path
from typing import Any

from carts_viewer.app import ViewerApp
from carts_viewer.transport.guard import Proxy

LOCAL_NOTEBOOKS = ("http://localhost:8888", "http://127.0.0.1:8888")
"""Origins of a Jupyter server on this computer with its default port."""


class NotebookView:
    """A viewer that runs in this process and is displayed in an inline frame; close it to save the corrections.

    Attributes:
        app: the viewer.
        url: address of the page.
    """

    def __init__(self, app: ViewerApp, url: str, height: int) -> None:
        self.app, self.url, self._height = app, url, height

    def __enter__(self) -> "NotebookView":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Save and stop the viewer; `ProjectError` if corrections could not be saved."""
        self.app.close()

    def _repr_html_(self) -> str:
        return (
            f'<iframe src="{html.escape(self.url)}" width="100%" height="{self._height}" style="border: 0" '
            'allow="clipboard-write"></iframe>'
        )


def view(
    sequence: Path | str,
    *,
    origins: tuple[str, ...] = LOCAL_NOTEBOOKS,
    proxy_path: str | None = None,
    height: int = 720,
    **options: Any,
) -> NotebookView:
    """Open the viewer of a sequence in a notebook's cell.

    Args:
        sequence: the sequence file.
        origins: origins of the notebook in the browser, such as https://hub.example; only they can embed the page.
        proxy_path: path of jupyter-server-proxy, such as /user/me/proxy, if the browser cannot reach this computer's
            ports; by default that of JupyterHub, else none.
        height: height of the frame [px].
        options: further options of `ViewerApp.open`.

    Raises:
        CartsError: the sequence, its robot, its project or an option is not usable.
    """
    hub = os.environ.get("JUPYTERHUB_SERVICE_PREFIX")
    path = f"{hub.rstrip('/')}/proxy" if proxy_path is None and hub else proxy_path
    chosen: dict[str, Any] = {"port": 0, "proxy": Proxy("", origins), **options}
    app = ViewerApp.open(Path(sequence), **chosen)
    url = app.url if path is None else f"{path}/{app.page.server.get_port()}/"
    return NotebookView(app, url, height)
