"""What intents about masks and keypoints of others do."""

from pathlib import Path

from carts_core.errors import CartsError
from carts_core.project import import_annotations
from carts_core.recording.annotations import read_annotations
from carts_viewer import intents
from carts_viewer.context import Context, OpenRun
from carts_viewer.layers import Layer

_LONGEST = 4096


class ImportingHandler:
    """The handler that brings in what others marked."""

    def __init__(self, context: Context, run: OpenRun) -> None:
        self._context = context
        self._open_run = run
        self._session = context.session

    def handle(self, intent: intents.ImportMasks) -> None:
        """Import, show it, and say what it was.

        Raises:
            CartsError: it is outside of the allowed folders, cannot be read, or would replace something; nothing is
                changed then.
        """
        session = self._session
        place = intent.place.strip()[:_LONGEST]
        if not place:
            raise CartsError("Type where the masks are: a COCO or CVAT file, or a folder of PNG masks.")
        # As the folder is known by itself, whatever links lead to it.
        path = session.roots.checked(session.sequence.path.parent.resolve() / Path(place))
        found = read_annotations(path, session.sequence, intent.camera, confined=True)
        self._open_run.end("Stopped: masks were imported")
        self._context.save()
        report = import_annotations(session.editor.project, found, source=path.name, replace=intent.replace)
        session.editor.claim()
        self._context.refresh()
        self._context.change(layer=Layer.IMPORTED, imported=report.sentence(), error=None)
