"""Files that people take away: a mask as PNG, or all masks and the kinematics table as one zip."""

import io
import zipfile

from carts_core.export import KinematicsRow, file_name, kinematics_csv, mask_png
from carts_core.project import Key, MaskCorrection
from carts_viewer.picture import Painter
from carts_viewer.session import Session
from carts_viewer.state import Pose


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
            correction = self._project.get(Key.mask_correction(frame.index, camera.name))
            name = f"masks/{file_name(camera.name)}/{file_name(frame.frame_id)}.png"
            self._zip.writestr(name, frame_mask(self._painter, pose, camera.name, correction), zipfile.ZIP_STORED)
        self._rows.append(KinematicsRow(frame.frame_id, str(pose.source), self._session.joints(pose.scene)))
        self.done += 1
        return self.done < self.total

    def finish(self) -> bytes:
        """The zip file."""
        self._zip.writestr("kinematics.csv", kinematics_csv(self._session.scene, self._rows))
        self._zip.close()
        return self._file.getvalue()
