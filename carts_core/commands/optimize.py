"""`carts optimize`: correct the kinematics of frames and write masks and kinematics."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from ..data import Sequence
from ..errors import SettingsError
from ..evaluation import Starts, camera_groups, start_positions
from ..export import KinematicsRow, read_kinematics_csv, write_bytes
from ..features.extractor import FeatureExtractor
from ..optimization import FrameOptimizer, FreeParameters, OptimizerSettings, SequenceOptimizer, SequenceSettings
from .frame_folder import FrameFolder
from .hints import base_frame_hint
from .selection import Mode, Network, Selection, SequencePath


@dataclass(frozen=True)
class Optimize:
    """Correct the kinematics of frames; write masks (PNG) and kinematics (CSV). Run it again to go on."""

    sequence: SequencePath
    """Sequence file."""
    output: Path | None = None
    """Folder to write to; by default `runs/NAME/DOMAIN/CAMERA`, with the names of all cameras if they look together."""
    overwrite: bool = False
    """Start over, although the folder holds results of other settings."""
    mode: Mode = "frame"
    """Correct each frame alone, or all together, each knowing what the others found (docs/sequences.md)."""
    together: bool = False
    """Let all chosen cameras look at a frame in one optimization (stereo); otherwise each works alone."""
    keyframes: Path | None = None
    """`sequence` mode: kinematics table of frames that a person set (its rows with the source `edited`)."""
    perturb_deg: float = 0.0
    """Start that many degrees (and millimetres) off on every joint; see `carts evaluate`."""
    seed: int = 0
    """Seed of the perturbation's signs; these are the same in all frames in sequence mode."""
    select: Annotated[Selection, tyro.conf.arg(name="")] = field(default_factory=Selection)
    free: Annotated[FreeParameters, tyro.conf.arg(name="")] = field(default_factory=FreeParameters)
    network: Annotated[Network, tyro.conf.arg(name="")] = field(default_factory=Network)
    optimizer: Annotated[OptimizerSettings, tyro.conf.arg(name="")] = field(default_factory=OptimizerSettings)
    model: Annotated[SequenceSettings, tyro.conf.arg(name="")] = field(default_factory=SequenceSettings)

    def run(self) -> None:
        """Optimize what is not there yet."""
        if self.keyframes is not None and self.mode != "sequence":
            raise SettingsError(f"--keyframes {self.keyframes} needs --mode sequence. Add it, or leave both out.")
        console = Console()
        sequence = Sequence.open(self.sequence, progress=console.print)
        extractor = FeatureExtractor.load(*self.network.weights, device=self.network.device)
        frames = self.select.frame_indices(sequence)
        for domain in self.select.domain_names(sequence):
            for cameras in camera_groups(self.select.camera_names(sequence.scene), self.together):
                folder = (self.output or Path("runs") / sequence.name) / domain / "+".join(cameras)
                self._run_cameras(sequence, extractor, frames, domain, cameras, folder, console)

    def _run_cameras(
        self,
        sequence: Sequence,
        extractor: FeatureExtractor,
        frames: list[int],
        domain: str,
        cameras: tuple[str, ...],
        folder: Path,
        console: Console,
    ) -> None:
        rows = self._earlier_rows(sequence, extractor, folder)
        output = FrameFolder(sequence, cameras, folder, rows)
        done = output.complete()
        todo = [index for index in frames if sequence.frame_ids[index] not in done]
        if len(todo) < len(frames):
            console.print(f"{folder}: {len(frames) - len(todo)} of {len(frames)} frames are there already")
        if self.mode == "sequence":
            # Every frame depends on all others, so one that is missing has all of them done again.
            run, todo = self._as_sequence, frames if todo else []
        else:
            run = self._alone
        run(sequence, extractor, todo, domain, cameras, output, console)
        console.print(f"wrote masks and kinematics.csv of {len(output.rows)} frames to {folder}")

    def _alone(
        self,
        sequence: Sequence,
        extractor: FeatureExtractor,
        todo: list[int],
        domain: str,
        cameras: tuple[str, ...],
        output: FrameFolder,
        console: Console,
    ) -> None:
        needed = todo and self.optimizer.needs_background
        background = {camera: sequence.background(camera, domain) for camera in cameras} if needed else {}
        where, gains = f"{domain}, {', '.join(cameras)}", []
        for index in track(todo, where, console=console, disable=not todo):
            frame = sequence.frame(index, domain, cameras)
            optimizer = FrameOptimizer(
                sequence.scene,
                frame,
                background,
                extractor,
                start=start_positions(sequence, frame, self.perturb_deg, self.seed),
                settings=self.optimizer,
                free=self.free,
                cameras=cameras,
                live=False,
            )
            for _ in optimizer:
                pass
            best = optimizer.best
            assert best is not None
            row = KinematicsRow(frame.frame_id, "optimized", best.joint_positions(), best.joint_std())
            output.write([(row, best.state)])
            gains.append(optimizer.base_frame_gain())
        hint = base_frame_hint(where, gains)
        if hint is not None:
            console.print(hint, style="yellow")

    def _as_sequence(
        self,
        sequence: Sequence,
        extractor: FeatureExtractor,
        todo: list[int],
        domain: str,
        cameras: tuple[str, ...],
        output: FrameFolder,
        console: Console,
    ) -> None:
        if not todo:
            return
        starts = Starts(sequence, domain, cameras, self.perturb_deg, self.seed)
        optimizer = SequenceOptimizer(
            sequence.scene,
            starts.frame,
            starts.times(todo),
            extractor,
            settings=self.optimizer,
            model=self.model,
            free=self.free,
            keyframes=self._keyframes(sequence, todo),
            cameras=cameras,
        )
        try:
            for _ in track(optimizer, f"{domain}, {', '.join(cameras)}", total=len(todo), console=console):
                pass
        finally:
            # Ctrl-C keeps what is there.
            output.write(
                [
                    (
                        KinematicsRow(
                            estimate.frame_id,
                            "edited" if estimate.start == "keyframe" else "optimized",
                            estimate.joint_positions,
                            estimate.joint_std,
                        ),
                        estimate.state,
                    )
                    for estimate in optimizer.estimates.values()
                ]
            )
        console.print(f"{optimizer.frames_per_second:.1f} frames/s")

    def _keyframes(self, sequence: Sequence, chosen: list[int]) -> dict[int, Mapping[str, np.ndarray]]:
        """Position -> joint positions of the chosen frames that a person set."""
        if self.keyframes is None:
            return {}
        rows = {
            row.frame_id: row.joint_positions
            for row in read_kinematics_csv(self.keyframes, sequence.scene)
            if row.source == "edited"
        }
        return {index: rows[sequence.frame_ids[index]] for index in chosen if sequence.frame_ids[index] in rows}

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
        if self.mode == "sequence":
            settings |= {"mode": self.mode, "model": asdict(self.model), "keyframes": self._keyframes_sha256()}
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

    def _keyframes_sha256(self) -> str | None:
        if self.keyframes is None:
            return None
        try:
            return hashlib.sha256(self.keyframes.read_bytes()).hexdigest()
        except OSError as error:
            raise SettingsError(
                f"--keyframes {self.keyframes} cannot be read: {error.strerror}. Name a file."
            ) from error
