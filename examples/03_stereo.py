"""Optimize with two cameras: a second view reduces the uncertainty, especially in depth.

python examples/03_stereo.py [--sequence stereo/sequence.toml] [--picture stereo.png]

Without --sequence, a small stereo pair is synthesized first, which requires `pip install 'carts[synthesis]'`.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.evaluation import joint_mae_deg
from carts_core.export import image_and_mask, outlined
from carts_core.lab.synthesis import EndoscopeConfig, MotionConfig, RenderConfig, SynthesisConfig, synthesize
from carts_core.model.perturbation import perturb
from carts_core.networks import FeatureExtractor
from carts_core.optimization import FrameOptimizer
from carts_core.process import tune_process
from carts_core.recording import Sequence
from carts_core.rendering import Renderer


def synthesized(folder: Path) -> Path:
    """Synthesize one small stereo frame; returns its sequence file."""
    config = SynthesisConfig(
        seed=12,
        domains=("regular",),
        endoscope=EndoscopeConfig(width=480, height=360, stereo=True),
        motion=MotionConfig(frames=1),
        render=RenderConfig(samples=4, robot_faces=12_000, tissue_resolution=200, texture_resolution=512),
    )
    synthesize(config, folder, lambda what, done, total: print(f"{what}: {done} of {total}"))
    return folder / "sequence.toml"


def main(sequence: Path | None = None, picture: Path = Path("stereo.png")) -> None:
    """Optimize the first frame with the first camera, then with all cameras."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Sequence.open(sequence or synthesized(Path(folder) / "stereo"))
        frame = recording.frame(0)
    scene, extractor = recording.scene, FeatureExtractor.load()
    cameras = [camera.name for camera in scene.cameras]
    start = perturb(scene, frame.truth or frame.measured, degrees=2.0, seed=1)
    for chosen in (cameras[:1], cameras):
        optimizer = FrameOptimizer(scene, frame, {}, extractor, start=start, cameras=chosen, live=False)
        list(optimizer)
        assert optimizer.best is not None
        found = optimizer.best.joint_positions()
        text = ", ".join(
            f"{arm} insertion +- {1000 * std[2]:.2f} mm" for arm, std in optimizer.best.joint_std().items()
        )
        if frame.truth is not None:
            error = joint_mae_deg(scene, found, frame.truth, recording.measured_joints)
            text += f", mean error of revolute joints {error:.2f} deg"
        print(f"{' and '.join(chosen)}: {text}")

    masks = [image_and_mask(Renderer(scene, cameras=[name]), scene.state(found))[1] for name in cameras]
    views = [outlined(frame.images[name], mask) for name, mask in zip(cameras, masks, strict=True)]
    cv2.imwrite(str(picture), np.hstack(views)[..., ::-1])
    print(f"wrote {picture}")


if __name__ == "__main__":
    tune_process()
    tyro.cli(main)
