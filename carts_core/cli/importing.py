"""`carts import` writes a sequence file for a recording; `carts import-masks` adds masks to a project."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from ..console import Bar, Terminal
from ..settings.interchange import AnnotationFormat, DrawnOn, ImportOptions
from .options import SequencePath

if TYPE_CHECKING:
    import numpy as np

    from ..recording.importing.found import FoundRecording


_STYLES = {"found": "green", "guessed": "yellow", "missing": "magenta", "warning": "red"}


@dataclass(frozen=True)
class Import:
    """Write a sequence file for a recording; without SOURCE, list the supported formats. The recording is not
    copied."""

    source: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")] = None
    """File or folder of the recording."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Folder to create for sequence.toml and its tables; by default `NAME_sequence` in the current folder."""
    overwrite: bool = False
    """Replace an earlier import."""
    options: Annotated[ImportOptions, tyro.conf.arg(name="")] = field(default_factory=ImportOptions)

    def run(self) -> None:
        """Print a report on the recording, and write the sequence file."""
        from ..files.decoding import prepare

        if self.source is not None:
            prepare()  # The decoder process starts while the modules below are imported.
        from ..recording.importing.found import recording_name
        from ..recording.importing.importer import import_recording, known_kinds

        console = Console()
        if self.source is None:
            console.print(f"carts import SOURCE reads:\n{known_kinds()}", markup=False, highlight=False, soft_wrap=True)
            return
        folder = self.output or Path(f"{recording_name(self.source)}_sequence")
        with Bar(console=console) as bar:

            def show(done: int, total: int) -> None:
                task = bar.task_ids[0] if bar.task_ids else bar.add_task("motion in the images")
                bar.update(task, completed=done, total=total)

            path, recording = import_recording(
                self.source, folder, self.options, overwrite=self.overwrite, progress=show
            )
        print_report(console, recording)
        console.print(f"wrote {path}. To view it: carts view {path}", markup=False, soft_wrap=True)
        if any(arm.times is not None for arm in recording.arms):
            text = f"To estimate a delay between images and log again: carts time-offset {path}"
            console.print(text, markup=False, soft_wrap=True)


def print_report(console: Console, recording: "FoundRecording") -> None:
    """Print the content of a recording, with guessed and missing values."""
    frames, times = len(recording.frame_ids), recording.frame_times
    span = "" if times is None or frames < 2 else f", {times[-1] - times[0]:.1f} s, {_rate(times):.1f} images/s"
    console.print(f"{recording.name}: {recording.kind}, {frames} frames{span}", markup=False)
    for arm in recording.arms:
        if arm.times is not None and len(arm.times) > 1:
            rows = f"{len(arm.times)} rows, {_rate(arm.times):.1f} rows/s"
            console.print(f"{arm.name}: {rows}, {', '.join(arm.columns)}", markup=False)
    for note in recording.notes:
        console.print(f"[{_STYLES[note.kind]}]{note.kind}[/]: ", end="")
        console.print(str(note), markup=False, highlight=False, soft_wrap=True)


def _rate(times: "np.ndarray") -> float:
    return (len(times) - 1) / max(float(times[-1] - times[0]), 1e-9)


@dataclass(frozen=True)
class ImportMasks:
    """Import masks and keypoints into the project of a sequence, as layers separate from painted layers.

    Reads COCO, LabelMe, X-AnyLabeling and Label Studio (.json), CVAT for images (.xml), YOLO segmentation labels,
    folders of mask images, EndoVis 2017 and 2018, and keypoints of SurgPose. The import is one undo step in `carts
    view`.
    """

    sequence: SequencePath
    """Sequence file."""
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """File or folder with the masks or keypoints."""
    project: Path | None = None
    """Project file; by default the project beside the sequence."""
    camera: str | None = None
    """Camera of the images, if its name does not occur in the names of files and folders."""
    format: AnnotationFormat | None = None
    """Format of the source; recognized by content by default."""
    drawn_on: DrawnOn | None = None
    """Images of a camera with distortion that were annotated; by default undistorted ones for exports of carts with
    such images or masks, otherwise recorded ones."""
    replace: bool = False
    """Replace earlier imports. Painted layers are not changed."""

    def run(self) -> None:
        """Import the masks and print a report."""
        from ..project import Project, import_annotations
        from ..recording import Sequence
        from ..recording.annotations import read_annotations

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        found = read_annotations(self.source, sequence, self.camera, format=self.format, drawn_on=self.drawn_on)
        with Project.open(sequence, self.project) as project:
            report = import_annotations(project, found, source=self.source.name, replace=self.replace)
            console.print(report.sentence())
            if report.changed:
                console.print(f"saved in {project.path}; one undo step in carts view")
