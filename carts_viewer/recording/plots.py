"""Small pictures of a recording for the form: images of its cameras, and its joints over time as SVG."""

from collections.abc import Sequence as Rows
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from carts_core.model.psm_kinematics import JOINT_NAMES
from carts_core.recording import Sequence
from carts_core.recording.importing.found import FoundArm, FoundRecording
from carts_core.recording.importing.writing import write_sequence
from carts_viewer.transport.document import escaped

COLORS = ("#2dd4a7", "#60a5fa", "#facc15", "#e879f9", "#fb923c", "#f87171", "#a3a3a3")
_WIDTH, _HEIGHT = 600, 150
_MOST_POINTS = 400
_PREVIEW_WIDTH = 360
_JPEG_QUALITY = 75


def joints_plot(arm: FoundArm) -> str:
    """All joints of an arm over time as SVG, each from its smallest to its largest value, with these in a legend."""
    if arm.values is None or not len(arm.values):
        return ""
    rows = np.unique(np.linspace(0, len(arm.values) - 1, min(len(arm.values), _MOST_POINTS)).astype(int))
    x = rows.astype(float) if arm.times is None else arm.times[rows]
    x = (x - x[0]) / max(float(x[-1] - x[0]), 1e-9) * (_WIDTH - 8) + 4
    lines, legend = [], []
    for column, (name, color) in enumerate(zip(arm.columns, COLORS, strict=False)):
        values = arm.values[rows, column]
        low, high = float(np.nanmin(arm.values[:, column])), float(np.nanmax(arm.values[:, column]))
        y = _HEIGHT - 6 - (values - low) / max(high - low, 1e-9) * (_HEIGHT - 12)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True) if np.isfinite(b))
        lines.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        scale, unit = (1e3, "mm") if name == JOINT_NAMES[2] else (180 / np.pi, "°")
        legend.append(
            f'<span style="white-space: nowrap; margin-right: 12px"><span class="key" style="background: {color}">'
            f"</span>{escaped(name.replace('_', ' '))} {scale * low:.0f} to {scale * high:.0f} {unit}</span>"
        )
    picture = f'<svg class="plot" viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none">{"".join(lines)}</svg>'
    return f"<figure style='margin: 0'>{picture}<figcaption>{''.join(legend)}</figcaption></figure>"


def opened(recording: FoundRecording) -> tuple[Sequence, TemporaryDirectory[str]]:
    """The recording as a sequence, with the folder that its tables are in meanwhile.

    Raises:
        CartsError: what was found does not make a sequence.
    """
    folder = TemporaryDirectory(prefix="carts-import-")
    try:
        return Sequence.open(write_sequence(recording, Path(folder.name) / "sequence")), folder
    except BaseException:
        folder.cleanup()
        raise


def previews(sequence: Sequence, camera: str) -> list[tuple[str, bytes]]:
    """First, middle and last image of a camera: name of the frame and JPEG file.

    Raises:
        CartsError: an image is missing or damaged.
    """
    found = []
    for index in dict.fromkeys((0, len(sequence) // 2, len(sequence) - 1)):
        frame = sequence.frame(index, cameras=[camera])
        found.append((frame.frame_id, small_jpeg(frame.images[camera])))
    return found


def small_jpeg(image: np.ndarray) -> bytes:
    """An RGB image as a small JPEG file."""
    height = max(1, round(image.shape[0] * _PREVIEW_WIDTH / image.shape[1]))
    small = cv2.resize(image, (_PREVIEW_WIDTH, height), interpolation=cv2.INTER_AREA)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), options)[1].tobytes()


def spread_out(places: Rows[np.ndarray] | np.ndarray, count: int) -> list[int]:
    """Rows whose places are far from each other, in order: the most typical one first, then the furthest from all."""
    points = np.asarray(places, float)
    chosen = [int(np.linalg.norm(points - np.median(points, axis=0), axis=1).argmin())]
    while len(chosen) < min(count, len(points)):
        distances = np.min([np.linalg.norm(points - points[row], axis=1) for row in chosen], axis=0)
        chosen.append(int(distances.argmax()))
    return sorted(chosen)
