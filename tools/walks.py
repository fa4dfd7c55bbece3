"""Modules of three call paths, found by tracing; see docs/explanation/architecture.md.

`python -m tools.walks` prints the modules of both packages whose functions run (module level and imports left out)
from a slider's value to the overlay, from a frame on disk to the result, and for an exported mask.
"""

import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

from carts_core.export import Dataset, export, measured_frames
from carts_core.networks import FeatureExtractor
from carts_core.optimization import Backgrounds, FrameOptimizer
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence
from carts_viewer.app import ViewerApp
from tools.raw_tab import RawTab

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("carts_core", "carts_viewer")
_SETTLE, _LONGEST = 3.0, 30.0
"""Timeouts for other work of the page, and for an overlay [s]."""


class Trace:
    """Modules of the packages whose functions are called during a trace, in all threads started after it."""

    def __init__(self) -> None:
        self._on, self._files = False, {}
        threading.setprofile(self._called)
        sys.setprofile(self._called)

    def _called(self, frame: FrameType, event: str, _: object) -> None:
        if self._on and event == "call" and frame.f_code.co_name != "<module>":
            self._files.setdefault(frame.f_code.co_filename)

    @contextmanager
    def on(self) -> Iterator[list[str]]:
        """Trace the block; afterwards the list contains the modules, in the order of their first call."""
        found: list[str] = []
        self._files.clear()
        self._on = True
        try:
            yield found
        finally:
            self._on = False
            paths = [Path(file) for file in self._files if Path(file).is_relative_to(ROOT)]
            found += [
                path.relative_to(ROOT).as_posix() for path in paths if path.relative_to(ROOT).parts[0] in PACKAGES
            ]


def slider(trace: Trace, recording: Path) -> list[str]:
    """Move the first joint's slider over a web socket, and wait for the overlay."""
    with ViewerApp.open(recording, port=0) as app:
        app.wait_until_shown(120)
        with RawTab(app.url) as tab:
            element = app.page.element_id(app.view.layout.joints.slider(app.scene.arms[0].name, 0))
            app.wait_until_shown(120)
            time.sleep(_SETTLE)
            with trace.on() as found:
                shown, ends = len(tab.overlays), time.monotonic() + _LONGEST
                tab.set(element, 3.0)
                while len(tab.overlays) == shown and time.monotonic() < ends:
                    time.sleep(0.02)
    # The panels follow the overlay, and are traced until the tab has received it.
    return found[: found.index("carts_viewer/picture/scene_view.py") + 1]


def frame(trace: Trace, sequence: Sequence, extractor: FeatureExtractor) -> list[str]:
    """Read a frame of an open sequence from disk, and solve it with the default solver."""
    with trace.on() as found:
        read = sequence.frame(0)
        backgrounds = Backgrounds.of(sequence, read.images, read.domain)
        optimizer = FrameOptimizer(sequence.scene, read, backgrounds, extractor)
        for _ in optimizer:
            pass
        assert optimizer.best is not None
        optimizer.best.joint_positions()
    return found


def mask(trace: Trace, sequence: Sequence, folder: Path) -> list[str]:
    """Export the masks of a frame of an open sequence."""
    with trace.on() as found:
        frames = tuple(measured_frames(sequence, [0]))
        export(Dataset(sequence, frames, sequence.scene, sequence.domains[0]), "masks", folder / "masks")
    return found


def show(title: str, found: list[str]) -> None:
    """Print a call path."""
    print(f"{title}: {len(found)} files")
    for path in found:
        print(f"  {path}")


def walks() -> None:
    """Print the three call paths."""
    trace = Trace()
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "sequence"
        shutil.copytree(sample_sequence().parent, copy)
        recording = copy / sample_sequence().name
        sequence, extractor = Sequence.open(recording), FeatureExtractor.load()
        show("slider to overlay", slider(trace, recording))
        show("frame to result", frame(trace, sequence, extractor))
        show("exported mask", mask(trace, sequence, Path(folder)))


if __name__ == "__main__":
    walks()
