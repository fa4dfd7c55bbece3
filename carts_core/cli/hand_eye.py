"""`carts hand-eye`: base frames from points that a person has found in a few images."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from ..console import Terminal
from .selection import SequencePath, output_folder

if TYPE_CHECKING:
    from collections.abc import Sequence as Points

    from ..optimization.hand_eye import HandEyeResult, ImagePoint
    from ..recording import Sequence


@dataclass(frozen=True)
class HandEye:
    """Find base frames from points that were found by eye in 3 to 6 images; no initial pose is needed.

    In `carts view` (New recording) the points are clicked. Here they are in a table; docs/howto/own_recording.md.
    """

    sequence: SequencePath
    """Sequence file; base frames in it may be anything."""
    points: Path
    """CSV file with the columns frame (its id), camera, arm, landmark (tip, wrist yaw joint, wrist pitch joint,
    shaft edge, shaft middle), u and v [px of the undistorted image, from its upper left corner]."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/hand_eye`."""
    overwrite: bool = False
    """Replace an earlier result there."""
    focal_length: bool = False
    """Find the focal lengths, too. Needs points at several depths; see the deviation that is said."""
    free_cameras: tuple[str, ...] = ()
    """Cameras whose pose relative to the others is not known."""
    pixel_error: float = 2.0
    """Expected error of a point [px]."""

    def run(self) -> None:
        """Solve and write; nothing is written after an error."""
        from ..files import MARKER, published, write_text
        from ..optimization.hand_eye import (
            RESULT_FILE,
            HandEyeSettings,
            mounts_of_points,
            moved_cameras,
            read_points,
            result_json,
            solve_hand_eye,
        )
        from ..recording import Sequence, calibrated_sequence_file

        console = Terminal()
        settings = HandEyeSettings(self.pixel_error, self.focal_length, self.free_cameras)
        sequence = Sequence.open(self.sequence, progress=console.print)
        points = read_points(self.points, sequence)
        mounts = mounts_of_points(sequence, points)
        result = solve_hand_eye(moved_cameras(sequence.scene, mounts), sequence.measured, points, settings)
        result = replace(result, scene=moved_cameras(result.scene, mounts, back=True))
        output = output_folder(self.output, sequence.name, "hand_eye")
        with published(output, overwrite=self.overwrite) as folder:
            text = calibrated_sequence_file(sequence.path, output.path, sequence.scene, result.scene, "hand-eye")
            write_text(folder / "sequence.toml", text)
            content = result_json(sequence, points, result, self.free_cameras)
            write_text(folder / RESULT_FILE, json.dumps(content, indent=1))
            write_text(folder / MARKER, json.dumps({"format": "hand-eye", "sequence": str(self.sequence)}, indent=1))
        _print(console, sequence, points, result)
        console.print(f"wrote {output}. Refine it over the recording: carts calibrate {output}/sequence.toml")


def _print(console: Console, sequence: "Sequence", points: "Points[ImagePoint]", result: "HandEyeResult") -> None:
    used = len(result.distances) - len(result.contradicting)
    console.print(f"{used} points agree to {result.error:.1f} px")
    for (arm, camera), deviation in result.deviations.items():
        console.print(
            f"{arm} before {camera}: known to {deviation.sideways_mm:.1f} mm sideways, {deviation.depth_mm:.1f} mm in "
            f"depth and {deviation.rotation_deg:.1f} deg"
        )
    for camera, deviation in result.focal_deviation.items():
        focal = result.scene.camera(camera).intrinsics[0]
        console.print(f"{camera}: focal length {focal:.0f} px, known to {100 * deviation:.0f} %")
    for (arm, camera), more in result.missing.items():
        console.print(f"{arm} before {camera} stays as it was: {more} more points are needed")
    for index in result.contradicting:
        point = points[index]
        where = f"{point.arm} {point.landmark} in frame {sequence.frame_ids[point.frame]}, camera {point.camera}"
        console.print(f"row {index + 2} ({where}) contradicts the others: {result.distances[index]:.0f} px off")
