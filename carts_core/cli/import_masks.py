"""`carts import-masks`: masks and keypoints of others as layers of a project."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..console import Terminal
from .selection import SequencePath


@dataclass(frozen=True)
class ImportMasks:
    """Put masks and keypoints of others into the project of a sequence, as layers beside what was painted.

    Reads COCO (.json), CVAT for images (.xml), folders of PNG masks, EndoVis 2017 and 2018, and keypoints of SurgPose.
    It is one step of undo in `carts view`.
    """

    sequence: SequencePath
    """Sequence file."""
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """File or folder with the masks or keypoints."""
    project: Path | None = None
    """Project file; by default that beside the sequence."""
    camera: str | None = None
    """Whose images they are, where names of files and folders do not say it."""
    replace: bool = False
    """Replace what was imported before. What was painted is never touched."""

    def run(self) -> None:
        """Import, and say what."""
        from ..project import Project, import_annotations
        from ..recording import Sequence
        from ..recording.annotations import read_annotations

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        found = read_annotations(self.source, sequence, self.camera)
        with Project.open(sequence, self.project) as project:
            report = import_annotations(project, found, source=self.source.name, replace=self.replace)
            console.print(report.sentence())
            if report.changed:
                console.print(f"saved in {project.path}; undone by one step in carts view")
