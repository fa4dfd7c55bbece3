"""What `carts optimize` does."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..console import Bar, Terminal, track
from ..data import Sequence
from ..evaluation import Starts, camera_groups, start_positions
from ..export import KinematicsRow, read_kinematics_csv
from ..features.extractor import FeatureExtractor
from ..optimization import Backgrounds, FrameOptimizer, SequenceOptimizer
from ..optimization.parameters import ParameterVector
from ..wording import counted
from .frame_folder import FrameFolder
from .hints import base_frame_hint, kept_start_hint, print_hints
from .optimize import Optimize
from .selection import output_folder


@dataclass(frozen=True)
class _Part:
    """The frames of a domain, as cameras see them that work together."""

    domain: str
    cameras: tuple[str, ...]
    output: FrameFolder

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.domain}, {', '.join(self.cameras)}"


class Optimizing:
    """Corrects frames as a command line asks for.

    Args:
        asked: the command line.
    """

    def __init__(self, asked: Optimize) -> None:
        self._asked, self._console = asked, Terminal()
        self._sequence = Sequence.open(asked.sequence, progress=self._console.print)
        self._frames = asked.select.frame_indices(self._sequence)
        self._keyframes = self._read_keyframes()
        self._extractor = FeatureExtractor.load(*asked.network.weights, device=asked.network.device)

    def run(self) -> None:
        """Optimize what is not there yet.

        Raises:
            CartsError: something cannot be done as asked for; whatever can be known of that before is told before
                anything is written.
        """
        scene, select = self._sequence.scene, self._asked.select
        groups = camera_groups(select.camera_names(scene), self._asked.together)
        parts = [self._part(domain, group) for domain in select.domain_names(self._sequence) for group in groups]
        for part in parts:
            self._run(part)

    def _part(self, domain: str, cameras: tuple[str, ...]) -> _Part:
        asked, sequence = self._asked, self._sequence
        scene = sequence.scene.with_cameras(cameras)
        start = scene.state({arm: rows[0] for arm, rows in sequence.measured.items()})
        # Made for its errors: no name of what is free or locked may be wrong.
        ParameterVector(scene, start, asked.free, asked.optimizer.lever)
        folder = output_folder(asked.output, sequence.name) / domain / "+".join(cameras)
        return _Part(domain, cameras, FrameFolder(sequence, cameras, folder, self._settings(), asked.overwrite))

    def _run(self, part: _Part) -> None:
        frames, output = self._frames, part.output
        done = output.complete()
        todo = [index for index in frames if self._sequence.frame_ids[index] not in done]
        if len(todo) < len(frames):
            self._console.print(
                f"{output.folder}: {len(frames) - len(todo)} of {counted(len(frames), 'frame')} already there"
            )
        if self._asked.mode == "frame":
            self._each_alone(todo, part)
        elif todo:
            # Every frame depends on all others, so one that is missing has all of them done again.
            self._as_sequence(part)
        if todo:
            self._console.print(
                f"wrote masks and kinematics.csv of {counted(len(output.rows), 'frame')} to {output.folder}"
            )

    def _each_alone(self, todo: list[int], part: _Part) -> None:
        asked, sequence, domain, cameras = self._asked, self._sequence, part.domain, part.cameras
        if not todo:
            return
        backgrounds = Backgrounds.of(sequence, cameras, domain, required=asked.optimizer.needs_background)
        stopped, gains = [], []
        for index in track(todo, part.name, console=self._console, disable=not todo):
            frame = sequence.frame(index, domain, cameras)
            optimizer = FrameOptimizer(
                sequence.scene,
                frame,
                backgrounds,
                self._extractor,
                start=start_positions(sequence, frame, asked.start.perturb_deg, asked.start.seed),
                settings=asked.optimizer,
                free=asked.free,
                cameras=cameras,
                live=False,
            )
            for _ in optimizer:
                pass
            best = optimizer.best
            assert best is not None and optimizer.stop_reason is not None
            row = KinematicsRow(frame.frame_id, "optimized", best.joint_positions(), best.joint_std())
            part.output.write([(row, best.state)])
            stopped.append(optimizer.stop_reason)
            gains.append(optimizer.base_frame_gain())
        print_hints(
            self._console,
            kept_start_hint(part.name, stopped),
            base_frame_hint(part.name, gains),
            *backgrounds.problems,
        )

    def _as_sequence(self, part: _Part) -> None:
        asked, sequence, frames, cameras = self._asked, self._sequence, self._frames, part.cameras
        backgrounds = Backgrounds.of(sequence, cameras, part.domain)
        starts = Starts(sequence, part.domain, cameras, asked.start.perturb_deg, asked.start.seed)
        optimizer = SequenceOptimizer(
            sequence.scene,
            starts.frame,
            starts.times(frames),
            self._extractor,
            settings=asked.optimizer,
            model=asked.model,
            free=asked.free,
            keyframes=self._keyframes,
            backgrounds=backgrounds,
            cameras=cameras,
        )
        try:
            with Bar(console=self._console) as bar:
                task = bar.add_task(part.name, total=len(frames))
                for _ in optimizer:
                    bar.update(task, completed=optimizer.progress[0])
        finally:
            # Ctrl-C keeps what is there.
            part.output.write(
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
        self._console.print(f"{optimizer.frames_per_second:.1f} frames/s")

    def _read_keyframes(self) -> dict[int, Mapping[str, np.ndarray]]:
        """Position -> joint positions of the chosen frames that a person set."""
        if self._asked.keyframes is None:
            return {}
        ids = self._sequence.frame_ids
        rows = {
            row.frame_id: row.joint_positions
            for row in read_kinematics_csv(self._asked.keyframes, self._sequence.scene)
            if row.source == "edited"
        }
        return {index: rows[ids[index]] for index in self._frames if ids[index] in rows}

    def _settings(self) -> dict[str, Any]:
        """All that the frames depend on."""
        asked = self._asked
        settings = {
            "sequence": str(asked.sequence.resolve()),
            "weights": self._extractor.sha256,
            "perturb_deg": asked.start.perturb_deg,
            "seed": asked.start.seed,
            "free": asdict(asked.free),
            "optimizer": asdict(asked.optimizer.resolved()),
        }
        if asked.mode == "sequence":
            keyframes = asked.keyframes and hashlib.sha256(asked.keyframes.read_bytes()).hexdigest()
            settings |= {"mode": asked.mode, "model": asdict(asked.model), "keyframes": keyframes}
        return settings
