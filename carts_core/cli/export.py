"""`carts render` writes images of the arms; `carts export` writes frames in the formats of other tools."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ..console import Bar, Terminal, track
from ..errors import SettingsError
from ..settings import FormatName, Images, Masks, Parts
from ..stopping import message_if_stopped
from ..wording import counted
from .options import Network, Perturbation, ProjectOption, Selection, SequencePath, output_folder

if TYPE_CHECKING:
    from ..export import ExportFrame
    from ..recording import Sequence


@dataclass(frozen=True)
class Render:
    """Render the arms, alone or over the images, with the corrections of the project beside the sequence."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Output folder; by default `runs/NAME/render`."""
    style: Literal["overlay", "image", "mask"] = "overlay"
    """Rendering blended over the image, rendering alone, or mask."""
    opacity: float = 0.6
    """Opacity of the rendering in an overlay, 0 to 1."""
    source: Annotated[ProjectOption, tyro.conf.arg(name="")] = field(default_factory=ProjectOption)
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
        with (
            locked_folder(folder),
            message_if_stopped(f"the images written to {folder} so far are complete; the remaining ones are missing"),
        ):
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


@dataclass(frozen=True)
class Export:
    """Export frames as masks, kinematics, base frames or a video; see docs/reference/exports.md for the formats.

    The corrections of the project beside the sequence are applied; without a project, measured poses are exported.
    """

    sequence: SequencePath
    """Sequence file."""
    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUTPUT")]
    """Folder to create, or file for csv, npz, json and dvrk."""
    format: FormatName
    """Export format."""
    kinematics: Path | None = None
    """Kinematics table of `carts optimize` to export instead of a project's corrections."""
    source: Annotated[ProjectOption, tyro.conf.arg(name="")] = field(default_factory=ProjectOption)
    parts: Parts = "arms"
    """Categories: one per arm, per part (shaft, wrist, jaws), or per link."""
    images: Images = "named"
    """`named`: labels refer to the images of the recording, and formats that require images beside their labels (bop,
    voc, yolo) get copies; `copied`: copies for every format; `none`: no images. Copies are bit-identical."""
    frame_rate: float | None = None
    """Frame rate of a video [1/s]; by default the median rate of the exported frames, or 25 without timestamps."""
    masks: Masks = "auto"
    """Masks of the formats masks, coco, yolo, voc, cvat, datumaro, rosbag2, lerobot, surgsync and recorded-csv:
    `rendered` at the corrected pose, or `refined` near their outline by the network; `auto` refines the masks of frames
    with the verdict *good*. Rendered masks of refined views are written to the folder `rendered`."""
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)
    recording: Path | None = None
    """Recording to which the results are added (lerobot, surgsync, recorded-csv); by default the one that the sequence
    was imported from."""
    overwrite: bool = False
    """Replace an earlier export."""
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)

    def run(self) -> None:
        """Write the export; no files are left after Ctrl-C or an error."""
        from ..export import FORMATS, Dataset, ExportProgress, export, network_refiner
        from ..recording import Sequence

        if self.recording is not None and not FORMATS[self.format].source:
            raise SettingsError(f"--recording: the format {self.format} is not written into a recording. Leave it out.")
        console = Terminal()
        sequence = Sequence.open(self.sequence, progress=console.print)
        domains = self.select.domain_names(sequence)
        if len(domains) > 1:
            raise SettingsError(f"--domain: {len(domains)} domains were given, but an export has one domain. Give one.")
        cameras = self.select.camera_names(sequence.scene)
        sequence, frames = self._frames(sequence, cameras, console)
        dataset = Dataset(
            sequence,
            tuple(frames),
            sequence.scene.with_cameras(cameras),
            domains[0],
            parts=self.parts,
            images=self.images,
            frame_rate=self.frame_rate,
            masks=self.masks,
            refine=network_refiner(self.network.load),
            recording=self.recording,
        )
        with Bar(console=console) as bar:
            task = bar.add_task(f"{self.format}, {counted(len(frames), 'frame')}", total=None)
            progress = ExportProgress(lambda done, total: bar.update(task, completed=done, total=total))
            with message_if_stopped(f"nothing was written to {self.output}"):
                path = export(dataset, self.format, self.output, overwrite=self.overwrite, progress=progress)
        if FORMATS[self.format].images and self.images != "none" and dataset.remade_cameras:
            cameras_named = ", ".join(dataset.remade_cameras)
            reason = "they are undistorted, cropped, rotated, or from a video or bag, so labels match no recorded file"
            console.print(f"images of {cameras_named} are written as PNG: {reason}", soft_wrap=True)
        sources = [dataset.mask_source(frame, camera) for _, frame, camera in dataset.steps]
        if FORMATS[self.format].refines and (refined := sources.count("refined")):
            number = f"{refined} of {counted(len(sources), 'mask')}"
            console.print(f"{number} were refined near the outline; the rendered masks are in the folder `rendered`")
        console.print(f"wrote {path}")

    def _frames(
        self, sequence: "Sequence", cameras: list[str], console: Terminal
    ) -> "tuple[Sequence, list[ExportFrame]]":
        """Corrected recording, and frames to export."""
        from ..export import corrected_frames, measured_frames, project_frame, read_kinematics_csv

        indices = self.select.frame_indices(sequence)
        if self.kinematics is not None:
            if self.source.named:
                raise SettingsError("--kinematics and --project are mutually exclusive. Give only one of them.")
            if (beside := self.source.path(sequence.path)) is not None:
                console.print(f"{beside} is not used, since --kinematics is given", soft_wrap=True)
            return sequence, corrected_frames(sequence, indices, read_kinematics_csv(self.kinematics, sequence.scene))
        project = self.source.read(sequence)
        if project is None:
            return sequence, measured_frames(sequence, indices)
        from ..project.state import corrected_sequence
        from ..rendering import Renderer

        console.print(self.source.sentence(sequence, project, indices), soft_wrap=True)
        corrected = corrected_sequence(sequence, project)
        renderers = {camera: Renderer(corrected.scene, cameras=[camera]) for camera in cameras}
        frames = [
            project_frame(corrected, project, index, cameras, lambda pose, name: renderers[name].segment(pose)[0] >= 0)
            for index in track(indices, "reading the project", console=console)
        ]
        return corrected, frames
