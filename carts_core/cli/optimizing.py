"""Optimization of `carts optimize`, and its output folder: masks, kinematics, and provenance in results.json."""

import hashlib
import json
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Mapping
from collections.abc import Sequence as Several
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch

from ..console import Bar, Terminal, track
from ..errors import SettingsError
from ..evaluation import Setup, camera_groups
from ..export import KinematicsRow, kinematics_csv, mask_png, read_kinematics_csv
from ..export.kinematics import position_values, std_values
from ..files import OutputPath, holds_file, locked_folder, remove_file, write_bytes, write_text
from ..model.scene import Scene, SceneState
from ..optimization import Assessment, Origin, SequenceOptimizer, StopReason, sequence_checkpoint
from ..optimization.variables import Variables
from ..provenance import (
    RESULTS_FORMAT,
    Record,
    calibration_fingerprint,
    code_fingerprint,
    fingerprint,
    read_records,
    robot_fingerprint,
)
from ..recording import Sequence
from ..rendering import Renderer
from ..settings import SurfaceSolver
from ..settings.serialization import to_plain
from ..stopping import finished_first, message_if_stopped
from ..wording import counted
from .options import RECORDING, Observer, OptimizeOptions, check_writable, output_folder
from .printing import (
    base_frame_hint,
    blank_hint,
    constant_correction_hint,
    kept_start_hint,
    print_hints,
    sequence_hint,
    verdict_hints,
    verdict_line,
)

InputHashes = Mapping[str, str]
"""Kind of input -> its fingerprint; the kinds are the keys of `_CHANGED`."""

_CHANGED = {
    "code": "another version of the program wrote the results",
    "weights": "the weights changed",
    "settings": "the settings changed",
    "robot": "the robot changed",
    "calibration": "the calibration changed",
    "joints": "the measured joint positions changed",
    "images": "the images changed",
    "masks": "the masks changed",
    "background": "the background changed",
    "together": "the frames were solved together with other frames",
}
"""Kind of input -> message if its fingerprint differs."""

_CODE = (
    "*.py",
    "imaging/**/*.py",
    "model/**/*.py",
    "recording/*.py",
    "evaluation/scores.py",
    "export/kinematics.py",
    "export/encodings.py",
    "networks/**/*.py",
    "optimization/**/*.py",
    "rendering/**/*.py",
)


class FrameInputs:
    """Fingerprints of the inputs of frames. No image is decoded, except for backgrounds.

    Args:
        settings: settings of the run, as text.
    """

    def __init__(self, setup: Setup, observer: Observer, settings: str) -> None:
        self._setup, self._observer, self._cameras = setup, observer, sorted(setup.cameras)
        sequence, backgrounds = setup.sequence, setup.backgrounds.images
        recorded = [sequence.recorded_camera(name) for name in setup.cameras]
        self._common = {
            "code": code_fingerprint(_CODE),
            "weights": fingerprint(observer.weights, str(observer.predictor.device)),
            "settings": fingerprint(settings),
            "robot": fingerprint(*(robot_fingerprint(arm.robot) for arm in sequence.scene.arms)),
            "calibration": calibration_fingerprint(sequence.scene, recorded),
            "background": fingerprint([(name, backgrounds[name]) for name in sorted(backgrounds)]),
        }

    @property
    def common(self) -> InputHashes:
        """Fingerprints of the inputs shared by all frames."""
        return self._common

    def of(self, index: int) -> InputHashes:
        """Fingerprints of the inputs of an individually corrected frame; `SequenceError` if an image is missing."""
        sequence, domain = self._setup.sequence, self._setup.domain
        start = self._setup.frame(index, cameras=()).measured
        joints = [(name, start[name], sequence.measured[name][index]) for name in sorted(start)]
        joints += sorted(sequence.mounts(index).items())
        images = [(name, sequence.image_fingerprint(index, name, domain)) for name in self._cameras]
        origin = {**self._common, "joints": fingerprint(joints), "images": fingerprint(images)}
        if self._observer.masked:
            masks = self._observer.mask_inputs(sequence, index, self._cameras, domain)
            origin["masks"] = fingerprint(masks)
        return origin

    def of_all(self, indices: Several[int]) -> InputHashes:
        """Fingerprints of the inputs of jointly corrected frames; each frame depends on the inputs of all frames."""
        each = [self.of(index) for index in indices]
        sequence = self._setup.sequence
        stamps = sequence.timestamps
        times = [None if stamps is None else float(stamps[index]) for index in indices]
        masks = {"masks": fingerprint(*(origin["masks"] for origin in each))} if self._observer.masked else {}
        return {
            **self._common,
            **masks,
            "joints": fingerprint(*(origin["joints"] for origin in each)),
            "images": fingerprint(*(origin["images"] for origin in each)),
            "together": fingerprint(indices, [sequence.frame_ids[index] for index in indices], repr(times)),
        }


def changes(before: InputHashes, now: InputHashes) -> str | None:
    """Description of the inputs in `now` that differ from those in `before`; None if all inputs in `now` are equal."""
    different = [kind for kind in _CHANGED if kind in now and before.get(kind) != now[kind]]
    if "together" in different:
        # A change of frames implies changes of joints, images and masks.
        different = [kind for kind in different if kind not in ("joints", "images", "masks")]
    if "calibration" in different:
        # Masks and backgrounds are compared after undistortion; the distortion is part of the calibration.
        different = [kind for kind in different if kind not in ("masks", "background")]
    if "joints" in different or "images" in different:
        # The background is computed from frames.
        different = [kind for kind in different if kind != "background"]
    return " and ".join(_CHANGED[kind] for kind in different) or None


def row_fingerprint(scene: Scene, row: KinematicsRow) -> str:
    """Fingerprint of a table row, at the precision of the file."""
    values = np.concatenate([position_values(scene, row), std_values(scene, row)])
    verdict = [row.verdict] if row.verdict else []
    return fingerprint(row.frame_id, row.source, [f"{value:.9g}" for value in values], *verdict)


@dataclass(frozen=True)
class FrameResult:
    """Result of a frame."""

    row: KinematicsRow
    state: SceneState
    origin: InputHashes
    """Fingerprints of the frame's inputs."""
    assessment: Assessment | None = None
    """Verdict on the result; None if not assessed."""


class FrameFolder:
    """Folder with masks, kinematics (`kinematics.csv`), settings (`settings.json`) and provenance (`results.json`).

    Masks are `masks/FRAME.png`, or `masks/CAMERA/FRAME.png` for several cameras. Files are written atomically, and a
    frame is complete only if all its files were written. The folder is not created or changed before the first frame is
    written.

    Args:
        settings: settings of the run; a folder with results of another `sequence` is refused.

    Attributes:
        rows: rows of the kinematics table.
        checkpoint: file with intermediate results of sequence mode.

    Raises:
        SettingsError: the folder holds results of another sequence, or cannot be written to.
    """

    def __init__(
        self,
        sequence: Sequence,
        cameras: tuple[str, ...],
        folder: OutputPath,
        settings: dict[str, Any],
        overwrite: bool,
    ) -> None:
        check_writable(folder.path)
        self.folder = folder
        self._order = {frame_id: index for index, frame_id in enumerate(sequence.frame_ids)}
        self._whole_scene, self._scene = sequence.scene, sequence.scene.with_cameras(cameras)
        masks = folder / "masks"
        self._masks = {camera: masks / camera if len(cameras) > 1 else masks for camera in cameras}
        self._table, self._settings_file = folder / "kinematics.csv", folder / "settings.json"
        self._records_file = folder / "results.json"
        self.checkpoint = folder / "checkpoint.txt"
        self._settings, self._overwrite = settings, overwrite
        self.rows: list[KinematicsRow] = []
        self._records: dict[str, Record] = {}
        self._check_settings()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder against other processes and read existing results; errors are those of the class."""
        with locked_folder(self.folder):
            self._check_settings()
            self._goes_on = holds_file(self._table) and not self._overwrite
            if self._goes_on:
                rows = read_kinematics_csv(self._table.path, self._whole_scene)
                known = {row.frame_id: row for row in rows if row.frame_id in self._order}
                self.rows = sorted(known.values(), key=lambda row: self._order[row.frame_id])
                self._records = read_records(self._records_file)
            yield

    def outdated_reason(self, frame_id: str, origin: InputHashes) -> str | None:
        """Reason why a frame's result is outdated with respect to the given input fingerprints; None if it is up to
        date.
        """
        record = self._records.get(frame_id)
        row = self.rows[bisect_left(self.rows, self._order[frame_id], key=lambda row: self._order[row.frame_id])]
        if record is None:
            return "the inputs are unknown"
        if record.row != row_fingerprint(self._scene, row):
            return "the rows in the table have changed"
        if changed := changes(record.origin, origin):
            return changed
        for camera, folder in self._masks.items():
            path = folder / f"{frame_id}.png"
            if not holds_file(path) or fingerprint(path.path.read_bytes()) != record.masks.get(camera):
                return "the masks are missing or damaged"
        return None

    def count_dropped(self, chosen: Several[str]) -> int:
        """Number of unselected frames whose results are removed when the first result is written."""
        if not self._overwrite or not holds_file(self._table):
            return 0
        return len(set(self._written_before()) - set(chosen))

    def write(self, results: Several[FrameResult]) -> None:
        """Write masks and rows of frames; signals are deferred to the end."""
        if not results:
            return
        with finished_first():
            if not self._goes_on:
                names = [masks / f"{name}.png" for name in self._written_before() for masks in self._masks.values()]
                for path in (*names, self._table, self._records_file):
                    remove_file(path)
                self._goes_on = True
            if self._settings_written() != self._settings:
                write_text(self._settings_file, json.dumps(self._settings, indent=1))
            for result in results:
                frame_id, fingerprints = result.row.frame_id, {}
                for camera, renderer in self._renderers.items():
                    png = mask_png(renderer.segment(result.state.to("cpu"))[0] >= 0)
                    write_bytes(self._masks[camera] / f"{frame_id}.png", png)
                    fingerprints[camera] = fingerprint(png)
                found = result.assessment
                self._records[frame_id] = Record(
                    result.origin,
                    fingerprints,
                    row_fingerprint(self._scene, result.row),
                    torch.get_num_threads(),
                    "" if found is None else found.verdict.value,
                    "" if found is None else found.reason,
                    None if found is None else round(found.probability, 6),
                    result.row.undetermined(self._scene),
                )
            new = {result.row.frame_id: result.row for result in results}
            rows = {row.frame_id: row for row in self.rows} | new
            self.rows = sorted(rows.values(), key=lambda row: self._order[row.frame_id])
            # The records are written last. A frame without a matching record, as after a kill, is repeated.
            write_text(self._table, kinematics_csv(self._scene, self.rows))
            known = {row.frame_id: self._records[row.frame_id] for row in self.rows if row.frame_id in self._records}
            # The file has one line per frame.
            lines = [f"{json.dumps(frame_id)}: {json.dumps(asdict(record))}" for frame_id, record in known.items()]
            content = f'{{"format": "{RESULTS_FORMAT}", "frames": {{\n' + ",\n".join(lines) + "\n}}\n"
            write_text(self._records_file, content)

    def _written_before(self) -> list[str]:
        """Frames of this sequence with results in the folder, for any settings."""
        if not holds_file(self._table):
            return []
        lines = self._table.path.read_text(encoding="utf-8", errors="replace").splitlines()
        ids = {line.partition(",")[0] for line in lines} | set(read_records(self._records_file))
        return [frame_id for frame_id in self._order if frame_id in ids]

    @cached_property
    def _renderers(self) -> dict[str, Renderer]:
        return {camera: Renderer(self._scene, cameras=[camera]) for camera in self._masks}

    def _check_settings(self) -> None:
        if self._overwrite or not holds_file(self._table):
            return
        if self._settings_written().get("sequence") != self._settings["sequence"]:
            raise SettingsError(
                f"{self.folder} holds results of another or an unknown sequence (see "
                f"{self._settings_file}). Add --overwrite to replace them, or choose another folder with --output."
            )

    def _settings_written(self) -> dict[str, Any]:
        """Settings of the newest results in the folder; empty if the file is missing or damaged."""
        if not holds_file(self._settings_file):
            return {}
        try:
            settings = json.loads(self._settings_file.path.read_bytes())
        except (ValueError, RecursionError):
            return {}
        return settings if isinstance(settings, dict) else {}


@dataclass(frozen=True)
class _Part:
    """Frames of one domain and one group of cameras that are optimized together."""

    setup: Setup
    output: FrameFolder

    @property
    def name(self) -> str:
        """Name displayed in the terminal."""
        return f"{self.setup.domain}, {', '.join(self.setup.cameras)}"


class OptimizeRun:
    """Correction of the selected frames, and output of the results."""

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
        for group in camera_groups(cameras, asked.together):
            self._observer.check(self._sequence, self._sequence.with_image(self._frames, group), group, domains)

    def run(self) -> None:
        """Optimize the frames without an up-to-date result; most errors are raised before anything is written."""
        scene, select = self._sequence.scene, self._asked.select
        groups = camera_groups(select.camera_names(scene), self._asked.together)
        parts = [self._part(domain, group) for domain in select.domain_names(self._sequence) for group in groups]
        with ExitStack() as held:
            for part in parts:
                held.enter_context(part.output.locked())
            for part in parts:
                with message_if_stopped(lambda part=part: self._kept(part)):
                    self._run(part)

    def _part(self, domain: str, cameras: tuple[str, ...]) -> _Part:
        asked, sequence = self._asked, self._sequence
        scene = sequence.scene.with_cameras(cameras)
        start = scene.state({arm: rows[0] for arm, rows in sequence.measured.items()})
        # This raises an error for unknown names of free or locked parameters.
        Variables(scene, start, self._free, self._solver.length_scale)
        folder = output_folder(asked.output, sequence.name) / domain / "+".join(cameras)
        model = asked.solving.sequence if asked.mode == "sequence" else None
        observer, offset = self._observer, asked.start
        what = observer.predictor, self._solver, self._free, model, offset.perturb_deg, offset.seed, observer.ignore
        setup = Setup(sequence, domain, cameras, *what)
        return _Part(setup, FrameFolder(sequence, cameras, folder, self._result_settings(), asked.overwrite))

    def _run(self, part: _Part) -> None:
        output, setup, together = part.output, part.setup, part.setup.model is not None
        seen = self._sequence.with_image(self._frames, setup.cameras)
        print_hints(self._console, blank_hint(part.name, self._frames, seen, carried=together and bool(seen)))
        if not seen:
            return
        frames = self._frames if together else seen
        origins = FrameInputs(setup, self._observer, json.dumps(self._result_settings()))
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
            first = next((index for index in todo if index in seen), seen[0])
            warned = self._observer.warnings(self._sequence, first, setup.domain, setup.cameras, background=known)
            print_hints(self._console, *warned)
        if not together:
            self._solve_frames(todo, part, now)
        elif todo:
            # Every frame depends on all other frames, so a missing frame requires solving all frames again.
            self._solve_sequence(part, now)
        else:
            # The checkpoint remains if the process was killed after the last result.
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
        faults = {
            index: output.outdated_reason(ids[index], origin) for index, origin in now.items() if ids[index] in there
        }
        reasons = Counter(fault for fault in faults.values() if fault)
        total, kept = counted(len(now), "frame"), sum(fault is None for fault in faults.values())
        if kept:
            self._console.print(f"{output.folder}: {kept} of {total} already done")
        for reason, count in reasons.items():
            self._console.print(f"{output.folder}: {count} of {total} redone: {reason}")
        return [index for index in now if index not in faults or faults[index]]

    def _report_others(self, part: _Part, common: InputHashes) -> None:
        """Report outdated results of frames that were not selected."""
        output, chosen = part.output, [self._sequence.frame_ids[index] for index in self._frames]
        if dropped := output.count_dropped(chosen):
            note = f"--overwrite removes the results of {counted(dropped, 'other frame')}"
            self._console.print(f"{output.folder}: {note}")
        others = [row.frame_id for row in output.rows if row.frame_id not in chosen]
        reasons = Counter(fault for frame_id in others if (fault := output.outdated_reason(frame_id, common)))
        for reason, count in reasons.items():
            note = f"results of {counted(count, 'frame')} outside of this run are outdated: {reason}"
            self._console.print(f"{output.folder}: {note}")

    def _kept(self, part: _Part) -> str:
        """Message on the kept results of a stopped run."""
        there = f"{part.output.folder} holds {counted(len(part.output.rows), 'frame')}"
        if self._running is not None:
            done, total = self._running.progress
            there = f"{done} of {counted(total, 'frame')} are solved and kept in {part.output.checkpoint}"
        return f"{there}; rerun the command to resume"

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

    def _solve_sequence(self, part: _Part, origins: Mapping[int, InputHashes]) -> None:
        # Joints and images are part of the keys of the measurements; given masks are not.
        inputs = origins[self._frames[0]].items()
        common = {kind: value for kind, value in inputs if kind not in ("joints", "images")}
        made_with = fingerprint(json.dumps(self._result_settings()), json.dumps(common))
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
            self._console.print("resumed an earlier run")
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
        """Print the verdicts on masks and the number of undetermined joints."""
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

    def _result_settings(self) -> dict[str, Any]:
        """Settings stored with the results. Inputs are stored as fingerprints (`FrameInputs`)."""
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
