"""Files that people take away: a mask as PNG, or all masks and the kinematics table as one zip."""

import io
import zipfile
from functools import singledispatchmethod
from typing import TYPE_CHECKING

from carts_core.export import KinematicsRow, file_name, kinematics_csv, mask_png
from carts_core.project import Key, MaskCorrection
from carts_viewer import intents as ask
from carts_viewer.checks import unknown
from carts_viewer.picture import Painter
from carts_viewer.session import Session
from carts_viewer.state import ExportState, Pose

if TYPE_CHECKING:
    from carts_viewer.controller import Controller


class Exporter:
    """The part of the controller that makes files."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._session = controller.session
        self._export: tuple[ZipExport, int] | None = None

    @singledispatchmethod
    def handle(self, intent: ask.Exporting) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    def patience(self) -> float | None:
        """0 while there is something to write; None when there is not."""
        return None if self._export is None else 0.0

    def advance(self) -> None:
        """Write the next frame, if there is one to write."""
        if self._export is None:
            return
        export, client_id = self._export
        if export.step():
            self._controller.change(export=ExportState(export.done, export.total))
            return
        self.cancel()
        self._controller.deliver(client_id, file_name(self._session.sequence.name) + ".zip", export.finish())

    def cancel(self) -> None:
        """Forget the export that is going on, if there is one."""
        self._export = None
        self._controller.change(export=None)

    @handle.register
    def _(self, intent: ask.ExportMask) -> None:
        state = self._controller.state
        name = file_name(f"{self._session.sequence.name}_{state.frame.frame_id}_{state.camera}") + ".png"
        mask = frame_mask(self._controller.painter, state.pose, state.camera, state.mask_correction)
        self._controller.deliver(intent.client_id, name, mask)

    @handle.register
    def _(self, intent: ask.ExportAll) -> None:
        export = ZipExport(self._session, self._controller.painter)
        self._export = (export, intent.client_id)
        self._controller.change(export=ExportState(0, export.total))

    @handle.register
    def _(self, intent: ask.CancelExport) -> None:
        self.cancel()


def frame_mask(painter: Painter, pose: Pose, camera: str, correction: MaskCorrection | None) -> bytes:
    """The corrected mask of a pose in one camera, as a PNG file of the camera's own size."""
    return mask_png(painter.mask(pose.scene, camera, correction))


class ZipExport:
    """Masks of every frame and camera and the kinematics table, built one frame at a time.

    Corrected frames are written as corrected, the others as measured; the table's column `source` says which.
    """

    def __init__(self, session: Session, painter: Painter) -> None:
        self.total = len(session.sequence)
        self.done = 0
        self._session = session
        self._painter = painter
        # The project as it is now, so that an edit during the export cannot make files and table disagree.
        self._project = session.editor.view
        self._file = io.BytesIO()
        self._zip = zipfile.ZipFile(self._file, "w", zipfile.ZIP_DEFLATED)
        self._rows: list[KinematicsRow] = []

    def step(self) -> bool:
        """Add the next frame; False when there are no more after it."""
        sequence = self._session.sequence
        frame = sequence.frame(self.done, cameras=[])
        pose = self._session.pose(frame, self._project)
        for camera in sequence.scene.cameras:
            name = f"masks/{file_name(camera.name)}/{file_name(frame.frame_id)}.png"
            correction = self._project.get(Key.mask_correction(frame.index, camera.name))
            self._zip.writestr(name, frame_mask(self._painter, pose, camera.name, correction), zipfile.ZIP_STORED)
        self._rows.append(KinematicsRow(frame.frame_id, str(pose.source), self._session.joints(pose.scene)))
        self.done += 1
        return self.done < self.total

    def finish(self) -> bytes:
        """The zip file."""
        self._zip.writestr("kinematics.csv", kinematics_csv(self._session.scene, self._rows))
        self._zip.close()
        return self._file.getvalue()
