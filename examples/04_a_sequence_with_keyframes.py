"""Correct several frames jointly with a keyframe, which is held fixed and constrains the other frames.

python examples/04_a_sequence_with_keyframes.py [--frames 4] [--picture sequence.png]
"""

from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from carts_core.evaluation import joint_mae_deg
from carts_core.networks import FeatureExtractor
from carts_core.optimization import SequenceOptimizer
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.resources import sample_sequence


def main(frames: int = 4, picture: Path = Path("sequence.png")) -> None:
    """Correct the first frames of the shipped sequence; the first one is a keyframe with true joint positions."""
    sequence = Sequence.open(sample_sequence())
    scene, truth = sequence.scene, sequence.truth
    assert truth is not None and sequence.timestamps is not None
    times = {index: float(sequence.timestamps[index]) for index in range(frames)}
    keyframes = {0: {arm: positions[0] for arm, positions in truth.items()}}

    optimizer = SequenceOptimizer(scene, sequence.frame, times, FeatureExtractor.load(), keyframes=keyframes)
    for estimate in optimizer:
        print(f"visited {estimate.frame_id}: {estimate.start}, loss {estimate.loss:.4f}, {estimate.seconds:.2f} s")

    errors = []
    for index, estimate in sorted(optimizer.estimates.items()):
        true = {arm: positions[index] for arm, positions in truth.items()}
        measured = {arm: positions[index] for arm, positions in sequence.measured.items()}
        errors.append(
            [
                joint_mae_deg(scene, found, true, sequence.measured_joints)
                for found in (measured, estimate.joint_positions)
            ]
        )
        print(f"{estimate.frame_id}: {errors[-1][0]:.2f} deg as measured, {errors[-1][1]:.2f} deg corrected")

    figure = Figure((6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(np.array(errors), marker="o", label=["as measured", "corrected"])
    axes.axvline(0, color="gray", linestyle=":", label="keyframe")
    axes.set(xlabel="frame", ylabel="mean error of revolute joints [deg]", xticks=range(frames), ylim=(0, None))
    axes.legend()
    figure.savefig(picture, dpi=150)
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
