"""The real app in a process of its own, until it is killed, and what a whole export looks like."""

import json
import threading
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import cv2
import torch
from viewer_run import run_without_end
from waiting import wait_for

from carts_core.files import MARKER
from carts_viewer.app import ViewerApp
from carts_viewer.panels.exchange import ExportPanel
from carts_viewer.panels.project import SavedPanel

FORMATS = ("PNG masks", "COCO", "Kinematics, CSV")
"""What is exported, as the page calls it."""


class Widgets(NamedTuple):
    """Where the app is, and the ids of its widgets."""

    url: str
    saved: str
    result: str
    """Of the export that was finished last."""
    frame: str
    joint: str
    note: str
    accept: str
    reject: str
    run: str
    format: str
    export: str
    steps: str


def serve(sequence: Path, weights: Path, tell: Connection) -> None:
    """Serve a sequence on a free port, tell where, and do what the page asks for."""
    open_and_tell(sequence, weights, tell)
    threading.Event().wait()


def open_and_tell(sequence: Path, weights: Path, tell: Connection) -> ViewerApp:
    """Open the app on a free port, and tell where it is."""
    torch.set_num_threads(1)
    app = ViewerApp.open(sequence, port=0, weights=(weights,))
    assert app.project.writable, app.notice
    # A run that ends by itself would leave nothing to be killed in the middle of.
    run_without_end(app)
    # The widgets are those of the tab that comes now.
    tell.send(app.url)
    wait_for(lambda: app.tabs.first.view is not None, 60)
    (saved,) = (panel for panel in app.view.display._panels if isinstance(panel, SavedPanel))
    (exports,) = (panel for panel in app.view.display._panels if isinstance(panel, ExportPanel))
    labels = "Note", "Accept", "Reject", "Run", "Format", "Export", "Go to"
    found = [
        saved._text,
        exports._result,
        app.view.page.find("Frame"),
        app.view.layout.joints.slider("PSM1", 0),
        *map(app.view.page.find, labels),
    ]
    tell.send(Widgets(app.url, *map(app.page.element_id, found)))
    return app


def check_whole(path: Path, frames: int) -> None:
    """Fail unless what has this final name is a whole export."""
    if path.suffix == ".csv":
        assert len(path.read_text().splitlines()) == frames + 1, path
        return
    assert len(json.loads((path / MARKER).read_text())["views"]) == frames, f"{path} is not finished"
    annotations = path / "annotations" / "instances_default.json"
    if annotations.exists():
        assert len(json.loads(annotations.read_text())["images"]) == frames, path
        folders = ()
    else:
        assert json.loads((path / "labels.json").read_text()).keys() == {"binary", "arms", "parts", "links"}, path
        folders = ("binary", "arms", "parts", "links")
    for folder in folders:
        pictures = list((path / folder).iterdir())
        assert len(pictures) == frames, path / folder
        for picture in pictures:
            assert cv2.imread(str(picture), cv2.IMREAD_UNCHANGED) is not None, picture
