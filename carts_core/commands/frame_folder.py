"""A folder of masks and a table of kinematics, as `carts optimize` fills it."""

from pathlib import Path

from ..data import Sequence
from ..export import KinematicsRow, kinematics_csv, mask_png, write_bytes
from ..rendering import Renderer
from ..scene import SceneState


class FrameFolder:
    """Masks (`masks/FRAME.png`) and kinematics (`kinematics.csv`) of one camera, never half written.

    Args:
        sequence, camera: whose frames these are.
        folder: where to write.
        rows: what is in its table already.
    """

    def __init__(self, sequence: Sequence, camera: str, folder: Path, rows: list[KinematicsRow]) -> None:
        self.rows, self._folder = rows, folder
        self._order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
        self._renderer = Renderer(sequence.scene, cameras=[camera])
        self._scene = sequence.scene.with_cameras([camera])

    def write(self, found: list[tuple[KinematicsRow, SceneState]]) -> None:
        """Write masks and rows of frames, in place of earlier ones."""
        for row, state in found:
            mask = self._renderer.segment(state.to("cpu"))[0] >= 0
            write_bytes(self._folder / "masks" / f"{row.frame_id}.png", mask_png(mask))
        new = {row.frame_id: row for row, _ in found}
        rows = {row.frame_id: row for row in self.rows} | new
        self.rows = sorted(rows.values(), key=lambda row: self._order[row.frame_id])
        # The table is written after the mask, so a frame in the table always has one.
        write_bytes(self._folder / "kinematics.csv", kinematics_csv(self._scene, self.rows).encode())
