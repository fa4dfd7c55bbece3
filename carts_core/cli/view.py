"""`carts view`: open a sequence in the browser."""

import gc
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..errors import SettingsError
from ..package_imports import gc_paused
from .options import Network


@dataclass(frozen=True)
class View:
    """Open a sequence in the browser; without a sequence, open the start page to choose or create one."""

    sequence: Annotated[Path | None, tyro.conf.Positional] = None
    """Sequence file, or the folder of a batch."""
    root: tuple[Path, ...] = ()
    """Folders that the start page may read; by default the current folder. With a sequence: additional folders from
    which masks may be imported.
    """
    project: Path | None = None
    """Project file with the corrections; by default beside the sequence, or in the user's data folder."""
    host: str = "127.0.0.1"
    """Address to listen on; by default only this machine can connect. Other machines need the token in the printed
    address.
    """
    port: int = 8080
    """Port to listen on; if it is in use, the next free port."""
    base_path: str = ""
    """Path of the page behind a reverse proxy, such as /x/y."""
    trusted_origin: tuple[str, ...] = ()
    """Origins at which browsers see the page through a proxy, such as https://host. Other origins are refused."""
    open_browser: bool = False
    """Open the page in the default browser."""
    segmenter: tuple[Path, Path] | None = None
    """Encoder and decoder of a SAM-type model as ONNX files, for the *Prompt* tool; by default the shipped model."""
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)

    def run(self) -> None:
        """Serve until Ctrl-C."""
        with gc_paused():
            from carts_viewer.serving import serve, serve_site
            from carts_viewer.transport.guard import Proxy

            from ..batch.folder import is_batch
        # Otherwise each garbage collection would scan all modules, which blocks the page for 0.2 s.
        gc.freeze()
        if self.segmenter is not None:
            from ..segmentation.onnx_segmenter import check_files

            check_files(*self.segmenter)
        options: dict[str, Any] = {
            "host": self.host,
            "port": self.port,
            "proxy": Proxy(self.base_path, self.trusted_origin),
            "device": self.network.processor,
            "inference": self.network.inference,
            "weights": self.network.weights,
            "segmenter": self.segmenter,
            "open_browser": self.open_browser,
        }
        if self.sequence is not None and not is_batch(self.sequence):
            serve(self.sequence, project=self.project, folders=self.root, **options)
            return
        if self.project is not None:
            raise SettingsError("--project requires a sequence. Also give the sequence file.")
        batch = None if self.sequence is None else self.sequence.resolve()
        roots = self.root or (Path(), *([self.sequence] if self.sequence is not None else []))
        serve_site(roots, batch=batch, **options)
