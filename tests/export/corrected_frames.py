"""Frames of an imported sequence with corrections, standard deviations and verdicts."""

from dataclasses import replace

import numpy as np

from carts_core.export import ExportFrame, measured_frames
from carts_core.recording import Sequence


def corrected(sequence: Sequence) -> list[ExportFrame]:
    """All frames; the second one as measured, the others corrected by different amounts."""
    frames = []
    for frame in measured_frames(sequence, range(len(sequence))):
        if frame.index == 1:
            frames.append(frame)
            continue
        size = 1e-3 * (1 + frame.index)
        positions = {
            name: values + size * np.cos(np.arange(len(values))) for name, values in frame.joint_positions.items()
        }
        std = {name: np.linspace(1e-4, 1e-3, len(values)) for name, values in positions.items()}
        verdict = "doubtful" if frame.index == 2 else "good"
        frames.append(replace(frame, source="optimized", joint_positions=positions, joint_std=std, verdict=verdict))
    return frames
