"""Camera that moves in front of the arm of a tiny sequence."""

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from carts_core.recording import Sequence
from carts_core.rendering import Renderer


@dataclass(frozen=True)
class Motion:
    """Pose of the camera mount in each frame."""

    Ts_world_mount: np.ndarray

    def write(self, path: Path, times: np.ndarray | None = None) -> None:
        """Table of poses; with times, a log."""
        with path.open("w", newline="") as handle:
            table = csv.writer(handle)
            table.writerow(["frame" if times is None else "time", "x", "y", "z", "qx", "qy", "qz", "qw"])
            for row, T in enumerate(self.Ts_world_mount):
                first = row + 1 if times is None else f"{times[row]:.6f}"
                values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
                table.writerow([first, *(f"{value:.12f}" for value in values)])


def swing(frames: int, degrees: float = 6.0, metres: float = 0.008) -> Motion:
    """Oscillating rotations and translations, starting with the mount at the world's origin."""
    Ts = np.tile(np.eye(4), (frames, 1, 1))
    for frame in range(frames):
        phase = 2 * np.pi * frame / max(frames, 2)
        turn = np.radians(degrees) * np.array([np.sin(phase), 0.6 * np.sin(2 * phase), 0.8 * np.sin(phase)])
        Ts[frame, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
        Ts[frame, :3, 3] = metres * np.array([np.sin(phase), np.sin(2 * phase), -np.sin(phase)])
    return Motion(Ts)


def let_camera_move(path: Path, motion: Motion) -> Path:
    """Add camera motion to a tiny sequence, with the corresponding images and masks.

    The motion is small against the distance, about an axis through the tip, so that the instrument stays in view.
    """
    motion.write(path.parent / "ecm.csv")
    path.write_text(path.read_text() + 'motion = "ecm.csv"\n')
    sequence = Sequence.open(path)
    (camera,) = sequence.scene.cameras
    renderer = Renderer(sequence.scene, width=camera.width, height=camera.height)
    for index, frame_id in enumerate(sequence.frame_ids):
        assert sequence.truth is not None
        joints = {arm: rows[index] for arm, rows in sequence.truth.items()}
        with torch.no_grad():
            rendering = renderer(sequence.scene.state(joints, mounts=sequence.mounts(index)))
        cover = rendering.silhouette[0].numpy()[..., None]
        image = cover * rendering.image[0].permute(1, 2, 0).numpy() + (1 - cover) * (0.55, 0.3, 0.25)
        pixels = np.rint(255 * image.clip(0, 1)).astype(np.uint8)
        cv2.imwrite(str(path.parent / "regular" / camera.name / f"{frame_id}.png"), pixels[..., ::-1])
        mask = 255 * (cover[..., 0] > 0.5).astype(np.uint8)
        cv2.imwrite(str(path.parent / "masks" / camera.name / f"{frame_id}.png"), mask)
    return path
