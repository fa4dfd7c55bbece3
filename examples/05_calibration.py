"""Calibrate a wrong base frame: move one arm's base by a centimetre, and estimate its pose from several frames.

python examples/05_calibration.py [--frames 4] [--picture calibration.png]

Joints are held fixed, since a rotated base frame and a constant error of the first joint are indistinguishable.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.export import image_and_mask, outlined
from carts_core.model.scene import Scene
from carts_core.networks import FeatureExtractor
from carts_core.optimization import CALIBRATION, CalibrationOptimizer
from carts_core.process import tune_process
from carts_core.recording import Frame, Sequence, evenly_spaced
from carts_core.rendering import Renderer
from carts_core.resources import sample_sequence


def moved(scene: Scene, arm: str, metres: tuple[float, float, float]) -> Scene:
    """Translate the base frame of one arm of a scene."""
    T = scene.arm(arm).T_world_base.copy()
    T[:3, 3] += metres
    arms = tuple(replace(each, T_world_base=T) if each.name == arm else each for each in scene.arms)
    return replace(scene, arms=arms)


def tip(scene: Scene, frame: Frame) -> np.ndarray:
    """Position of the point between the jaws of the first arm, in the frame of the first camera [m]."""
    state = scene.state(frame.measured)
    T_base_tip = scene.arms[0].robot.link_transform(state.joint_positions[0], "tool_tip_link")
    return (state.T_camera_world[0] @ state.T_world_base[0] @ T_base_tip)[:3, 3].numpy()


def main(frames: int = 4, picture: Path = Path("calibration.png")) -> None:
    """Calibrate the shipped sequence, with the true joint positions in place of the measured ones."""
    sequence = Sequence.open(sample_sequence())
    chosen = [sequence.frame(index) for index in evenly_spaced(len(sequence), frames)]
    chosen = [replace(frame, measured=frame.truth or frame.measured) for frame in chosen]
    wrong = moved(sequence.scene, "psm1", (0.006, -0.006, 0.006))

    free = replace(CALIBRATION, arms=("psm1",), extrinsics=False)
    optimizer = CalibrationOptimizer(wrong, chosen, FeatureExtractor.load(), free=free)
    for iterate in optimizer:
        print(f"stage {iterate.stage + 1} of {iterate.stages}: loss {iterate.loss:.4f}")
    result = optimizer.result()
    for unknown in result.unknowns:
        print(f"{unknown.name}: {unknown.change:+.2f} +- {unknown.deviation_between_frames:.2f} {unknown.unit}")
    true = tip(sequence.scene, chosen[0])
    for label, scene in (("before", wrong), ("after", result.scene)):
        print(f"tip of psm1 {label}: {1000 * np.linalg.norm(tip(scene, chosen[0]) - true):.1f} mm off")

    frame, camera = chosen[0], sequence.scene.cameras[0].name
    masks = [image_and_mask(Renderer(scene), scene.state(frame.measured))[1] for scene in (wrong, result.scene)]
    cv2.imwrite(str(picture), np.hstack([outlined(frame.images[camera], mask) for mask in masks])[..., ::-1])
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
