"""A folder of masks and a table of kinematics, as `carts optimize` fills it."""

from pathlib import Path

from ..data import Sequence
from ..export import KinematicsRow, kinematics_csv, mask_png, write_bytes
from ..rendering import Renderer
from ..scene import SceneState


class FrameFolder:
    """Masks and kinematics (`kinematics.csv`), never half written.

    A mask is `masks/FRAME.png`, or `masks/CAMERA/FRAME.png` where there are several cameras.

    Args:
        sequence, cameras: whose frames these are.
        folder: where to write.
        rows: what is in its table already.
    """

    def __init__(self, sequence: Sequence, cameras: tuple[str, ...], folder: Path, rows: list[KinematicsRow]) -> None:
        self.rows, self.folder = rows, folder
        self._order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
        self._scene = sequence.scene.with_cameras(cameras)
        folders = {camera: folder / "masks" / (camera if len(cameras) > 1 else "") for camera in cameras}
        self._views = {folders[camera]: Renderer(self._scene, cameras=[camera]) for camera in cameras}

    def complete(self) -> set[str]:
        """Frames that are in the table and have all their masks."""
        ids = (row.frame_id for row in self.rows)
        return {name for name in ids if all((masks / f"{name}.png").is_file() for masks in self._views)}

    def write(self, found: list[tuple[KinematicsRow, SceneState]]) -> None:
        """Write masks and rows of frames, in place of earlier ones."""
        for row, state in found:
            for masks, renderer in self._views.items():
                write_bytes(masks / f"{row.frame_id}.png", mask_png(renderer.segment(state.to("cpu"))[0] >= 0))
        new = {row.frame_id: row for row, _ in found}
        rows = {row.frame_id: row for row in self.rows} | new
        self.rows = sorted(rows.values(), key=lambda row: self._order[row.frame_id])
        # The table is written after the mask, so a frame in the table always has one.
        write_bytes(self.folder / "kinematics.csv", kinematics_csv(self._scene, self.rows).encode())
