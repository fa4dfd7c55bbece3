"""`carts optimize`: correct the kinematics of frames and write masks and kinematics."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import track

from ..data import Sequence
from ..errors import SettingsError
from ..evaluation import start_positions
from ..export import KinematicsRow, kinematics_csv, mask_png, read_kinematics_csv, write_bytes
from ..features.extractor import FeatureExtractor
from ..optimization import FrameOptimizer, FreeParameters, OptimizerSettings
from ..rendering import Renderer
from .selection import Network, Selection, SequencePath


@dataclass(frozen=True)
class Optimize:
    """Correct the kinematics of frames; write masks (PNG) and kinematics (CSV). Run it again to go on."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/DOMAIN/CAMERA`."""
    overwrite: bool = False
    """Start over, although the folder holds results of other settings."""
    perturb_deg: float = 0.0
    """Start that many degrees (and millimetres) off on every joint; see `carts evaluate`."""
    seed: int = 0
    """Seed of the perturbation's signs."""
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)
    free: Annotated[FreeParameters, tyro.conf.arg(name="")] = field(default_factory=FreeParameters)
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)
    optimizer: Annotated[OptimizerSettings, tyro.conf.arg(name="")] = field(default_factory=OptimizerSettings)

    def run(self) -> None:
        """Optimize what is not there yet."""
        console = Console()
        sequence = Sequence.open(self.sequence, progress=console.print)
        extractor = FeatureExtractor.load(*self.network.weights, device=self.network.device)
        frames = self.select.frame_indices(sequence)
        for domain in self.select.domain_names(sequence):
            for camera in self.select.camera_names(sequence.scene):
                folder = (self.output or Path("runs") / sequence.name) / domain / camera
                self._run_camera(sequence, extractor, frames, domain, camera, folder, console)

    def _run_camera(
        self,
        sequence: Sequence,
        extractor: FeatureExtractor,
        frames: list[int],
        domain: str,
        camera: str,
        folder: Path,
        console: Console,
    ) -> None:
        rows = self._earlier_rows(sequence, extractor, folder)
        done = {row.frame_id for row in rows if (folder / "masks" / f"{row.frame_id}.png").is_file()}
        todo = [index for index in frames if sequence.frame_ids[index] not in done]
        if len(todo) < len(frames):
            console.print(f"{folder}: {len(frames) - len(todo)} of {len(frames)} frames are there already")
        renderer = Renderer(sequence.scene, cameras=[camera])
        scene = sequence.scene.with_cameras([camera])
        background = {camera: sequence.background(camera, domain)} if todo else {}
        for index in track(todo, f"{domain}, {camera}", console=console, disable=not todo):
            frame = sequence.frame(index, domain, [camera])
            optimizer = FrameOptimizer(
                sequence.scene,
                frame,
                background,
                extractor,
                start=start_positions(sequence, frame, self.perturb_deg, self.seed),
                settings=self.optimizer,
                free=self.free,
                cameras=[camera],
            )
            for _ in optimizer:
                pass
            assert optimizer.best is not None
            mask = renderer.segment(optimizer.best.state.to("cpu"))[0] >= 0
            write_bytes(folder / "masks" / f"{frame.frame_id}.png", mask_png(mask))
            rows = [row for row in rows if row.frame_id != frame.frame_id]
            rows.append(KinematicsRow(frame.frame_id, "optimized", optimizer.best.joint_positions()))
            rows.sort(key=lambda row: sequence.frame_ids.index(row.frame_id))
            # The table is written after the mask, so a frame in the table always has one.
            write_bytes(folder / "kinematics.csv", kinematics_csv(scene, rows).encode())
        console.print(f"wrote {len(rows)} masks and kinematics.csv to {folder}")

    def _earlier_rows(self, sequence: Sequence, extractor: FeatureExtractor, folder: Path) -> list[KinematicsRow]:
        """Rows of an earlier, interrupted run with the same settings.

        Raises:
            SettingsError: the folder holds results of other settings.
        """
        settings = {
            "sequence": str(self.sequence.resolve()),
            "weights": extractor.sha256,
            "perturb_deg": self.perturb_deg,
            "seed": self.seed,
            "free": asdict(self.free),
            "optimizer": asdict(self.optimizer),
        }
        text = json.dumps(settings, indent=1)
        file, table = folder / "settings.json", folder / "kinematics.csv"
        same = file.is_file() and file.read_text(encoding="utf-8") == text
        if table.is_file() and not same and not self.overwrite:
            raise SettingsError(
                f"{folder} holds results of other settings (see {file}). "
                "Add --overwrite to replace them, or name another folder with --output."
            )
        if table.is_file() and same and not self.overwrite:
            return read_kinematics_csv(table, sequence.scene)
        table.unlink(missing_ok=True)
        write_bytes(file, text.encode())
        return []
