"""`carts render`: the arms as the kinematics say, as pictures."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..console import Terminal, track
from ..stopping import when_stopped
from .selection import FromProject, Perturbation, Selection, SequencePath, output_folder


@dataclass(frozen=True)
class Render:
    """Render the arms over the frames or alone, as the project beside the sequence corrects them, else as measured."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/render`."""
    style: Literal["overlay", "image", "mask"] = "overlay"
    """The rendering blended over the frame, alone, or its mask."""
    opacity: float = 0.6
    """Of the rendering in an overlay, 0 to 1."""
    source: Annotated[FromProject, tyro.conf.arg(name="")] = field(default_factory=FromProject)
    start: Annotated[Perturbation, tyro.conf.arg(name="")] = field(default_factory=Perturbation)
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)

    def run(self) -> None:
        """Write one PNG per frame, camera and domain."""
        from ..evaluation import start_positions
        from ..export import image_and_mask, image_png, mask_png, overlay
        from ..files import locked_folder, write_bytes
        from ..recording import Sequence
        from ..rendering import Renderer

        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        folder = output_folder(self.output, sequence.name, "render")
        frames = self.select.frame_indices(sequence)
        sequence = self.source.corrected(sequence, frames, console)
        with locked_folder(folder), when_stopped(f"the pictures in {folder} are whole, some are missing"):
            for domain in self.select.domain_names(sequence):
                for camera in self.select.camera_names(sequence.scene):
                    renderer = Renderer(sequence.scene, cameras=[camera])
                    for index in track(frames, f"{domain}, {camera}", console=console):
                        frame = sequence.frame(index, domain, [camera])
                        start = start_positions(sequence, frame, self.start.perturb_deg, self.start.seed)
                        state = sequence.scene.state(start, mounts=frame.mounts)
                        if self.style == "mask":
                            png = mask_png(renderer.segment(state)[0] >= 0)
                        else:
                            image, mask = image_and_mask(renderer, state)
                            if self.style == "overlay":
                                image = overlay(frame.images[camera], image, mask, self.opacity)
                            png = image_png(image)
                        write_bytes(folder / domain / camera / f"{frame.frame_id}.png", png)
        console.print(f"wrote {folder}")
