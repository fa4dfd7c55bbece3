"""The real app in a process of its own, exporting all the time, until it is killed."""

import itertools
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import torch

from carts_core.data import Sequence
from carts_core.export import Dataset, FormatName, export, measured_frames
from carts_core.export.publish import MARKER
from carts_viewer import intents as ask
from carts_viewer.app import ViewerApp
from carts_viewer.panels.project import SavedPanel

FORMATS: tuple[FormatName, ...] = ("masks", "csv", "coco")
LONG_RUN = {"working_width": 96, "attention_radius": 4, "wide_attention_radius": 8, "iterations": 10_000}
"""A run that ends by itself would leave nothing to be killed in the middle of."""


class Widgets(NamedTuple):
    """Where the app is, and the ids of its widgets."""

    url: str
    released: str
    frame: str
    joint: str
    note: str
    accept: str
    reject: str
    run: str
    export: str
    saved: str
    steps: str


def serve(sequence: Path, weights: Path, exports: Path, tell: Connection) -> None:
    """Serve a sequence on a free port, tell where, and export it into a folder, over and over."""
    torch.set_num_threads(1)
    app = ViewerApp.open(sequence, port=0, weights=(weights,))
    assert app.project.writable, app.notice
    for name, value in LONG_RUN.items():
        app.mailbox.put(ask.SetSetting(name, value))
    app.wait_until_shown(60)
    (saved,) = (panel for panel in app.display._panels if isinstance(panel, SavedPanel))
    found = [
        app.page._released,
        app.page.find("Frame"),
        app.joints.slider("PSM1", 0),
        *map(app.page.find, ("Note", "Accept", "Reject", "Run", "Export all")),
        saved._text,
        app.page.find("Go to"),
    ]
    tell.send(Widgets(app.url, *map(app.page.element_id, found)))
    for number in itertools.count():
        _export(app.sequence, exports, number)


def _export(sequence: Sequence, folder: Path, number: int) -> None:
    dataset = Dataset(
        sequence, tuple(measured_frames(sequence, range(len(sequence)))), sequence.scene, sequence.domains[0]
    )
    name = FORMATS[number % len(FORMATS)]
    # Few names, so that exports replace one another, too.
    export(dataset, name, folder / f"{name}-{number % 2}", overwrite=True)


def check_whole(path: Path, frames: int) -> None:
    """Fail unless what has this final name is a whole export."""
    if path.suffix == ".csv":
        assert len(path.read_text().splitlines()) == frames + 1, path
        return
    assert (path / MARKER).stat().st_size > 0, f"{path} is not finished"
    # One image at least for each frame, and none cut off.
    pictures = list(path.rglob("*.png"))
    assert len(pictures) >= frames, path
    for picture in pictures:
        assert picture.read_bytes().endswith(b"IEND\xaeB`\x82"), picture
