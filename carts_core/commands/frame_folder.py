"""A folder of masks and a table of kinematics, as `carts optimize` fills it."""

import json
from functools import cached_property
from typing import Any

from ..data import Sequence
from ..errors import SettingsError
from ..export import KinematicsRow, kinematics_csv, mask_png, read_kinematics_csv
from ..files import OutputPath, holds_file, remove_file, write_bytes, write_text
from ..rendering import Renderer
from ..scene import SceneState
from .selection import check_writable


class FrameFolder:
    """Masks, kinematics (`kinematics.csv`) and what they were made with (`settings.json`), never half written.

    A mask is `masks/FRAME.png`, or `masks/CAMERA/FRAME.png` where there are several cameras. Nothing is made or changed
    before the first frame is written.

    Args:
        sequence, cameras: whose frames these are.
        folder: where to write.
        settings: all that frames depend on; those in the folder count if theirs are the same.
        overwrite: start over, whatever is there.

    Attributes:
        rows: what is in the table.

    Raises:
        SettingsError: the folder holds results of other settings, or cannot be written to.
    """

    def __init__(
        self,
        sequence: Sequence,
        cameras: tuple[str, ...],
        folder: OutputPath,
        settings: dict[str, Any],
        overwrite: bool,
    ) -> None:
        check_writable(folder.path)
        self.folder = folder
        self._order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
        self._scene = sequence.scene.with_cameras(cameras)
        masks = folder / "masks"
        self._masks = {camera: masks / camera if len(cameras) > 1 else masks for camera in cameras}
        self._table, self._settings_file = folder / "kinematics.csv", folder / "settings.json"
        self._settings = json.dumps(settings, indent=1)
        self._goes_on = holds_file(self._table) and not overwrite
        if self._goes_on and not self._same_settings():
            raise SettingsError(
                f"{folder} holds results of other settings (see {self._settings_file}). "
                "Add --overwrite to replace them, or name another folder with --output."
            )
        self.rows = read_kinematics_csv(self._table.path, sequence.scene) if self._goes_on else []

    def complete(self) -> set[str]:
        """Frames that are in the table and have all their masks."""
        ids = (row.frame_id for row in self.rows)
        return {name for name in ids if all(holds_file(masks / f"{name}.png") for masks in self._masks.values())}

    def write(self, found: list[tuple[KinematicsRow, SceneState]]) -> None:
        """Write masks and rows of frames, in place of earlier ones."""
        if not found:
            return
        if not self._goes_on:
            remove_file(self._table)
            write_text(self._settings_file, self._settings)
            self._goes_on = True
        for row, state in found:
            for camera, renderer in self._renderers.items():
                mask = renderer.segment(state.to("cpu"))[0] >= 0
                write_bytes(self._masks[camera] / f"{row.frame_id}.png", mask_png(mask))
        new = {row.frame_id: row for row, _ in found}
        rows = {row.frame_id: row for row in self.rows} | new
        self.rows = sorted(rows.values(), key=lambda row: self._order[row.frame_id])
        # The table is written after the mask, so a frame in the table always has one.
        write_text(self._table, kinematics_csv(self._scene, self.rows))

    @cached_property
    def _renderers(self) -> dict[str, Renderer]:
        return {camera: Renderer(self._scene, cameras=[camera]) for camera in self._masks}

    def _same_settings(self) -> bool:
        file = self._settings_file
        return holds_file(file) and file.path.read_text(encoding="utf-8") == self._settings
