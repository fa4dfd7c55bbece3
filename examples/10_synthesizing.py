"""Synthesize a small path-traced recording with ground truth in several domains, and draw the arms over it.

python examples/10_synthesizing.py [OUTPUT] [--frames 1] [--seed 12] [--picture synthesized.png]

Requires `pip install 'carts[synthesis]'`. The sizes are small, so that it takes only seconds; the
shipped sequence was generated with the defaults of `carts synthesize`.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import tyro

from carts_core.export import image_and_mask, outlined
from carts_core.lab.synthesis import EndoscopeConfig, MotionConfig, RenderConfig, SynthesisConfig, synthesize
from carts_core.recording import Sequence
from carts_core.rendering import Renderer

DOMAINS = ("regular", "low_brightness", "bleeding", "smoke")


def main(
    output: tyro.conf.Positional[Path | None] = None,
    frames: int = 1,
    seed: int = 12,
    picture: Path = Path("synthesized.png"),
) -> None:
    """Synthesize a recording, and draw the arms at the measured joint positions in every domain."""
    config = SynthesisConfig(
        seed=seed,
        domains=DOMAINS,
        endoscope=EndoscopeConfig(width=320, height=240),
        motion=MotionConfig(frames=frames),
        render=RenderConfig(samples=4, robot_faces=12_000, tissue_resolution=200, texture_resolution=512),
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = output or Path(temporary) / "recording"
        synthesize(config, folder, lambda what, done, total: print(f"{what}: {done} of {total}"))
        sequence = Sequence.open(folder / "sequence.toml")
        camera = sequence.scene.cameras[0].name
        renderer, views = Renderer(sequence.scene), []
        for domain in sequence.domains:
            frame = sequence.frame(0, domain)
            _, mask = image_and_mask(renderer, sequence.scene.state(frame.measured))
            views.append(outlined(frame.images[camera], mask))
    print(f"{len(sequence)} frames in the domains {', '.join(sequence.domains)}")
    rows = [np.hstack(views[:2]), np.hstack(views[2:])]
    cv2.imwrite(str(picture), np.vstack(rows)[..., ::-1])
    print(f"wrote {picture}: outlines of the arms at the measured joint positions")


if __name__ == "__main__":
    tyro.cli(main)
