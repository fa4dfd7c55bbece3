"""Which project the viewer works on, and what people must know about it."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from carts_core.errors import ProjectError
from carts_core.project import DamagedProject, Project, default_path, rescued_copies
from carts_core.recording import Sequence


@dataclass(frozen=True)
class Storage:
    """An open project."""

    project: Project
    reason: str | None
    """Why what people do is not kept; None if it is."""
    scratch: tempfile.TemporaryDirectory | None = None
    """The folder of a project that ends with the viewer."""
    hint: str | None = None
    """Of what else there is of the project."""

    @property
    def kept(self) -> bool:
        """Whether what people do is kept, in the file at `project.path`."""
        return self.reason is None and self.project.safe

    @property
    def notice(self) -> str | None:
        """What people must know: why what they do is not kept, or that it is kept in another file, or that another one
        holds more; None if nothing."""
        return self.project.incident or self.reason or self.hint

    def close(self) -> None:
        """Let others write.

        Raises:
            ProjectError: what was saved is nowhere on disk any more.
        """
        try:
            self.project.close()
        finally:
            if self.scratch is not None:
                self.scratch.cleanup()


def open_storage(sequence: Sequence, path: Path | None = None) -> Storage:
    """Open, or begin, a sequence's project for the viewer.

    A project that may not be written to opens read-only. Where none can be begun, one is made that nothing keeps.

    Args:
        sequence: the recording.
        path: of the project; None for the default place.

    Raises:
        ProjectError: the file is of another sequence, of a newer version or no project, or `path` cannot be made.
    """
    try:
        project = Project.open(sequence, path)
    except DamagedProject:
        # It says what could be read of it, and where that is.
        raise
    except ProjectError as error:
        if (path or default_path(Path(sequence.path))).is_file():
            project = Project.open(sequence, path, read_only=True)
            return Storage(project, f"Read-only: {error}")
        if path is not None:
            raise
        scratch = tempfile.TemporaryDirectory(prefix="carts-")
        project = Project.open(sequence, Path(scratch.name) / "scratch.carts")
        return Storage(project, f"Nothing is kept after the viewer is closed: {error}", scratch)
    reason = None if project.writable else f"Read-only: {project.read_only_reason}"
    return Storage(project, reason, hint=_rescued_hint(project.path))


def _rescued_hint(path: Path) -> str | None:
    copies = rescued_copies(path)
    if not copies:
        return None
    newest, others = copies[0], f" (and {len(copies) - 1} earlier)" if len(copies) > 1 else ""
    return (
        f"What was rescued when {path.name} was lost or damaged is in {newest}{others}. It may hold corrections that "
        f"are not in {path.name}: open it with --project '{newest}', or remove it when nothing of it is needed."
    )
