"""Optimization and output of `carts optimize`."""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..console import Bar, Terminal, track
from ..evaluation import Setup, camera_groups
from ..export import KinematicsRow, read_kinematics_csv
from ..files import remove_file
from ..optimization import Origin, SequenceOptimizer, StopReason, sequence_checkpoint
from ..optimization.variables import Variables
from ..provenance import fingerprint
from ..recording import Sequence
from ..settings import SurfaceSolver
from ..settings.serialization import to_plain
from ..stopping import when_stopped
from ..wording import counted
from .options import RECORDING, OptimizeOptions, output_folder
from .printing import (
    base_frame_hint,
    constant_correction_hint,
    kept_start_hint,
    print_hints,
    sequence_hint,
    verdict_hints,
    verdict_line,
)
from .results_folder import FrameFolder, FrameInputs, FrameResult, InputHashes


@dataclass(frozen=True)
class _Part:
    """Frames of one domain, seen by cameras that are optimized together."""

    setup: Setup
    output: FrameFolder

    @property
    def name(self) -> str:
        """Name displayed in the terminal."""
        return f"{self.setup.domain}, {', '.join(self.setup.cameras)}"


class Optimizing:
    """Corrects the selected frames and writes the results."""

    def __init__(self, asked: OptimizeOptions) -> None:
        self._asked, self._console, self._solver = asked, Terminal(), asked.solving.chosen
        self._free = asked.solving.freed(asked.free)
        self._sequence = Sequence.open(asked.sequence, progress=self._console.print)
        self._frames = asked.select.frame_indices(self._sequence)
        self._keyframes = self._read_keyframes()
        self._running: SequenceOptimizer | None = None
        self._observer = asked.network.observer(self._solver, self._sequence)
        select = asked.select
        cameras, domains = select.camera_names(self._sequence.scene), select.domain_names(self._sequence)
        self._observer.check(self._sequence, self._frames, cameras, domains)

    def run(self) -> None:
        """Optimize the frames without an up-to-date result; most errors are raised before anything is written."""
        scene, select = self._sequence.scene, self._asked.select
        groups = camera_groups(select.camera_names(scene), self._asked.together)
        parts = [self._part(domain, group) for domain in select.domain_names(self._sequence) for group in groups]
        with ExitStack() as held:
            for part in parts:
                held.enter_context(part.output.held())
            for part in parts:
                with when_stopped(lambda part=part: self._kept(part)):
                    self._run(part)

    def _part(self, domain: str, cameras: tuple[str, ...]) -> _Part:
        asked, sequence = self._asked, self._sequence
        scene = sequence.scene.with_cameras(cameras)
        start = scene.state({arm: rows[0] for arm, rows in sequence.measured.items()})
        # Raises for unknown names of free or locked parameters.
        Variables(scene, start, self._free, self._solver.length_scale)
        folder = output_folder(asked.output, sequence.name) / domain / "+".join(cameras)
        model = asked.solving.sequence if asked.mode == "sequence" else None
        observer, offset = self._observer, asked.start
        what = observer.predictor, self._solver, self._free, model, offset.perturb_deg, offset.seed, observer.ignore
        setup = Setup(sequence, domain, cameras, *what)
        return _Part(setup, FrameFolder(sequence, cameras, folder, self._settings(), asked.overwrite))

    def _run(self, part: _Part) -> None:
        frames, output, setup, together = self._frames, part.output, part.setup, part.setup.model is not None
        origins = FrameInputs(setup, self._observer, json.dumps(self._settings()))
        common = origins.common
        if together:
            of_all = origins.of_all(frames)
            now, common = dict.fromkeys(frames, of_all), {**common, "together": of_all["together"]}
        else:
            now = {index: origins.of(index) for index in frames}
        todo = self._to_do(part, now)
        self._report_others(part, common)
        if todo and isinstance(self._solver, SurfaceSolver):
            known = setup.backgrounds.covers(self._sequence.scene.with_cameras(setup.cameras))
            warned = self._observer.warnings(self._sequence, todo[0], setup.domain, setup.cameras, background=known)
            print_hints(self._console, *warned)
        if not together:
            self._solve_frames(todo, part, now)
        elif todo:
            # Every frame depends on all others, so a missing one requires solving all again.
            self._solve_sequence(part, now, common)
        else:
            # Left behind if the process was killed after the last result.
            remove_file(output.checkpoint)
        if todo:
            print_hints(self._console, constant_correction_hint(part.name, self._sequence, output.rows))
            self._console.print(
                f"wrote masks and kinematics.csv of {counted(len(output.rows), 'frame')} to {output.folder}"
            )

    def _to_do(self, part: _Part, now: Mapping[int, InputHashes]) -> list[int]:
        """Indices of the selected frames without an up-to-date result; prints the reasons."""
        output, ids = part.output, self._sequence.frame_ids
        there = {row.frame_id for row in output.rows}
        faults = {index: output.fault(ids[index], origin) for index, origin in now.items() if ids[index] in there}
        reasons = Counter(fault for fault in faults.values() if fault)
        total, kept = counted(len(now), "frame"), sum(fault is None for fault in faults.values())
        if kept:
            self._console.print(f"{output.folder}: {kept} of {total} already there")
        for reason, count in reasons.items():
            self._console.print(f"{output.folder}: {count} of {total} redone: {reason}")
        return [index for index in now if index not in faults or faults[index]]

    def _report_others(self, part: _Part, common: InputHashes) -> None:
        """Report outdated results of frames that were not selected."""
        output, chosen = part.output, [self._sequence.frame_ids[index] for index in self._frames]
        if dropped := output.others_dropped(chosen):
            note = f"--overwrite starts over: results of {counted(dropped, 'other frame')} are removed"
            self._console.print(f"{output.folder}: {note}")
        others = [row.frame_id for row in output.rows if row.frame_id not in chosen]
        reasons = Counter(fault for frame_id in others if (fault := output.fault(frame_id, common)))
        for reason, count in reasons.items():
            note = f"{counted(count, 'frame')} not chosen now would have to be redone: {reason}"
            self._console.print(f"{output.folder}: {note}")

    def _kept(self, part: _Part) -> str:
        """Message on the results kept by a stopped run."""
        there = f"{part.output.folder} holds {counted(len(part.output.rows), 'frame')}"
        if self._running is not None:
            done, total = self._running.progress
            there = f"{done} of {counted(total, 'frame')} are solved and kept in {part.output.checkpoint}"
        return f"{there}; the same command goes on from there"

    def _solve_frames(self, todo: list[int], part: _Part, origins: Mapping[int, InputHashes]) -> None:
        if not todo:
            return
        stopped, gains, assessed = [], [], {}
        for index in track(todo, part.name, console=self._console):
            frame = part.setup.frame(index)
            optimizer = part.setup.solved(frame)
            best = optimizer.best
            assert best is not None and optimizer.stop_reason is not None
            found = assessed[frame.frame_id] = optimizer.assessment
            source = "measured" if optimizer.stop_reason is StopReason.FAILED else "optimized"
            verdict = None if found is None else found.verdict.value
            row = KinematicsRow(frame.frame_id, source, best.joint_positions(), best.joint_std(), verdict)
            part.output.write([FrameResult(row, best.state, origins[index], found)])
            stopped.append(optimizer.stop_reason)
            gains.append(optimizer.base_frame_gain())
        self._print_verdicts(part, list(assessed))
        print_hints(
            self._console,
            kept_start_hint(part.name, stopped),
            base_frame_hint(part.name, gains),
            *(() if self._observer.masked else part.setup.backgrounds.problems),
            *verdict_hints(part.name, assessed),
        )

    def _solve_sequence(self, part: _Part, origins: Mapping[int, InputHashes], common: InputHashes) -> None:
        made_with = fingerprint(json.dumps(self._settings()), json.dumps(dict(common)))
        checkpoint = sequence_checkpoint(part.output.checkpoint, made_with)
        optimizer = part.setup.sequence_optimizer(self._frames, keyframes=self._keyframes, checkpoint=checkpoint)
        self._running = optimizer
        with Bar(console=self._console) as bar:
            task = bar.add_task(part.name, total=len(self._frames))
            for _ in optimizer:
                bar.update(task, completed=optimizer.progress[0])
        self._running = None
        found = []
        for index, estimate in optimizer.estimates.items():
            source = {Origin.KEYFRAME: "edited", Origin.MEASURED: "measured"}.get(estimate.start, "optimized")
            verdict = None if estimate.assessment is None else estimate.assessment.verdict.value
            row = KinematicsRow(estimate.frame_id, source, estimate.joint_positions, estimate.joint_std, verdict)
            found.append(FrameResult(row, estimate.state, origins[index], estimate.assessment))
        part.output.write(found)
        checkpoint.remove()
        if checkpoint.recalled:
            self._console.print("went on from where an earlier run was stopped")
        else:
            self._console.print(f"{optimizer.frames_per_second:.1f} frames/s")
        assessed = {estimate.frame_id: estimate.assessment for estimate in optimizer.estimates.values()}
        self._print_verdicts(part, list(assessed))
        print_hints(
            self._console,
            sequence_hint(part.name, optimizer.assessment),
            base_frame_hint(part.name, [optimizer.base_frame_gain()]),
            *verdict_hints(part.name, assessed),
        )

    def _print_verdicts(self, part: _Part, frame_ids: list[str]) -> None:
        """Print verdicts on masks and the number of undetermined joints."""
        rows = [row for row in part.output.rows if row.frame_id in set(frame_ids)]
        joints = [row.undetermined(self._sequence.scene) for row in rows]
        if line := verdict_line(part.name, [row.verdict for row in rows], joints):
            self._console.print(line, soft_wrap=True)

    def _read_keyframes(self) -> dict[int, Mapping[str, np.ndarray]]:
        """Frame index -> joint positions of the selected keyframes."""
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
        """Settings stored with the results; inputs are stored as fingerprints (`FrameInputs`)."""
        asked = self._asked
        settings = {
            "sequence": str(asked.sequence.resolve()),
            "perturb_deg": asked.start.perturb_deg,
            "seed": asked.start.seed,
            "free": asdict(self._free),
            "solver": to_plain(self._solver),
        }
        if asked.network.observe != "network":
            settings["observe"] = asked.network.observe
        if asked.network.masks != RECORDING:
            settings["masks"] = asked.network.masks
        if asked.mode == "sequence":
            from ..files.reading import TABLE, read_bytes

            keyframes = asked.keyframes and hashlib.sha256(read_bytes(asked.keyframes, TABLE)).hexdigest()
            settings |= {"mode": asked.mode, "model": to_plain(asked.solving.sequence), "keyframes": keyframes}
        return settings
