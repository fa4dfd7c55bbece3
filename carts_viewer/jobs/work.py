"""Generators that do the work of jobs: optimizing frames, calibrating, and adapting the network."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Container, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from carts_core.errors import CartsError
from carts_core.files.reading import VALUES, parse_json, read_text
from carts_core.model.scene import Scene
from carts_core.project import (
    CorrectedIntrinsics,
    CorrectedTransform,
    Figures,
    Key,
    ProjectState,
    Provenance,
    ReviewState,
)
from carts_core.recording import evenly_spaced
from carts_core.settings import CALIBRATION_SETTINGS
from carts_core.stopping import PARENT
from carts_core.wording import counted
from carts_viewer.actions.context import Context
from carts_viewer.jobs.comparison import Comparison, Waiting
from carts_viewer.jobs.optimizers import OptimizerFactory, provenance
from carts_viewer.jobs.solver import Calibrated, Calibration, CalibrationStep, CalibrationTask, Started, scene_at

_ACCEPTED, _OPTIMIZED = ReviewState.ACCEPTED, ReviewState.OPTIMIZED


@dataclass(frozen=True)
class Progress:
    """Progress of a job."""

    done: int
    total: int
    text: str
    line: str | None = None
    """Line for the log."""
    wait: float = 0.0
    """Time until the next step is due [s]."""


def optimize_frames(
    context: Context, comparison: Comparison, frames: Sequence[int], first: int
) -> Generator[Progress | Waiting]:
    """Run the optimizer on frames individually, starting at index `first` of `frames`; worse results are discarded.

    Every frame is a separate undo step, and is saved before the next frame is started.
    """
    taken = worse = 0
    cameras = [camera.name for camera in context.session.scene.cameras]
    for place, index in enumerate(frames):
        if place < first:
            continue
        name = context.session.sequence.frame_ids[index]
        session = context.session
        if index in session.editor.view.kept_frames:
            yield Progress(place + 1, len(frames), f"{name} is kept", f"{name}: kept, not changed")
            continue
        yield Progress(place, len(frames), f"Frame {name}")
        target = session.target(context.state.observed)
        if not target.seen(session.sequence, index, context.state.domain, cameras):
            yield Progress(place + 1, len(frames), f"Frame {name} has no mask", f"{name}: no mask to fit, not changed")
            continue
        before = session.editor.view
        fit, edits, remark = yield from comparison.own_run(index, context.state)
        if remark is not None:
            worse += 1
            yield Progress(place + 1, len(frames), f"Frame {name}", f"{name}: discarded, worse than before ({remark})")
            continue
        now = session.editor.view
        if index in now.kept_frames or not now.same_pose(before, index):
            yield Progress(place + 1, len(frames), f"Frame {name}", f"{name}: discarded, edited during its run")
            continue
        context.save()
        changes = {**edits, Key.verdict(index): fit.verdict}
        session.editor.apply(f"Optimize, frame {name}", changes, {index: Figures(fit.loss, fit.dice)})
        context.refresh()
        taken += 1
        yield Progress(place + 1, len(frames), f"Frame {name}", f"{name}: {fit.verdict.verdict}, loss {fit.loss:.3g}")
    text = f"{counted(taken, 'frame')} optimized" + (f", {worse} discarded because they were worse" if worse else "")
    yield Progress(len(frames), len(frames), text)


def calibrate(context: Context, optimizers: OptimizerFactory, count: int) -> Generator[Progress | Waiting]:
    """Fit the free calibration parameters, by default the base frames, to frames spread over the sequence.

    The result is one undo step.
    """
    from carts_core.optimization.hand_eye import read_prior  # noqa: PLC0415  its import of SciPy takes time

    session, state = context.session, context.state
    sequence = session.sequence
    cameras = [camera.name for camera in session.scene.cameras]
    target = session.target(state.observed)
    usable = [index for index in range(len(sequence)) if target.covers(sequence, index, state.domain, cameras)]
    if not usable:
        raise CartsError(
            f"No frame has masks of all cameras ({', '.join(cameras)}) to calibrate with. Paint or import masks, or "
            "choose another target."
        )
    indices = [usable[place] for place in evenly_spaced(len(usable), min(count, len(usable)))]
    free = replace(
        state.free, base_frames=state.free.base_frames or not (state.free.extrinsics or state.free.intrinsics)
    )
    yield Progress(0, 0, f"Reading {len(indices)} frames")
    before = session.editor.view
    measured = session.measured(state.frame)
    ignored = tuple(session.ignored(index, cameras, target) for index in indices)
    scene = scene_at(session.scene, measured)
    prior = read_prior(sequence.path, scene)
    task = CalibrationTask(
        sequence,
        tuple(indices),
        state.domain,
        Calibration.of(scene),
        free,
        target,
        ignored,
        known_base_frames={} if prior is None else prior.base_covariances,
    )
    most, made_by, result = CALIBRATION_SETTINGS.iterations, None, None
    with closing(optimizers.calibration(task)) as steps:
        while (found := (yield from steps.next())) is not None:
            match found:
                case Started():
                    made_by = provenance(found, cameras, CALIBRATION_SETTINGS, free, target)
                case CalibrationStep():
                    stage = f"Stage {found.stage + 1} of {found.stages}"
                    text = f"{stage}, loss {found.loss:.4f}; at most {most} iterations"
                    yield Progress(found.index, most, text, text)
                case Calibrated():
                    result = found
    assert made_by is not None and result is not None
    for line in result.changes:
        yield Progress(most, most, "Comparing", line)
    verdict = f"{result.verdict.capitalize()}: {result.reason}" if result.verdict else ""
    edits = _calibration_edits(scene, result.calibration.applied_to(scene), made_by)
    if not edits:
        yield Progress(most, most, f"Nothing was changed. {verdict}")
        return
    if not session.editor.view.same_calibration(before):
        raise CartsError("The calibration was changed in the meantime, so this result is outdated. Calibrate again.")
    context.save()
    accepted, solved = (_count(session.editor.view, states) for states in ({_ACCEPTED}, {_ACCEPTED, _OPTIMIZED}))
    session.editor.apply(f"Calibrate on {len(indices)} frames", edits)
    context.refresh()
    again = " All masks have changed: run or solve fitted frames again." if solved else ""
    again += f" Accepted frames that became unreviewed: {accepted}." if accepted else ""
    done = f"Calibrated on {len(indices)} frames, one undo step.{result.moved}"
    if result.beyond:
        verdict += f" {result.beyond[:1].upper()}{result.beyond[1:]} Undo it, or check the clicked points."
    yield Progress(most, most, f"{done} {verdict}{again}")


def _count(project: ProjectState, states: Container[ReviewState]) -> int:
    """Number of frames in one of these review states."""
    return sum(project.review(index).state in states for index in project.records if index >= 0)


def _calibration_edits(before: Scene, after: Scene, provenance: Provenance) -> dict[Key[Any], Any]:
    """Edits that set the calibration of a project."""
    edits: dict[Key[Any], Any] = {}
    for old, new in zip(before.arms, after.arms, strict=True):
        if (old.T_world_base != new.T_world_base).any():
            edits[Key.base_frame(new.name)] = CorrectedTransform(
                tuple(map(tuple, new.T_world_base.tolist())), provenance
            )
    for old, new in zip(before.cameras, after.cameras, strict=True):
        if (old.T_camera_world != new.T_camera_world).any():
            matrix = tuple(map(tuple, new.T_camera_world.tolist()))
            edits[Key.extrinsics(new.name)] = CorrectedTransform(matrix, provenance)
        if old.intrinsics != new.intrinsics:
            edits[Key.intrinsics(new.name)] = CorrectedIntrinsics(tuple(new.intrinsics), provenance)
    return edits


TRAINING_OPTIONS: tuple[str, ...] = ()
"""Options of `carts train` in addition to the recording and the time."""
_POLL_INTERVAL = 0.25
"""Interval between checks of the training process [s]."""
_CHECKPOINT_TIME = 30.0
"""Time for a stopped training process to save its checkpoint [s]."""


def adapt(sequence: Path, folder: Path, minutes: float) -> Generator[Progress]:
    """Adapt the network in a child process and report progress; closing the generator stops the process.

    Training that was stopped earlier is resumed in its folder for the given minutes.

    Raises:
        CartsError: training failed.
    """
    training = _Training([str(folder), "--for", str(sequence), "--minutes", f"{minutes:g}", *TRAINING_OPTIONS])
    total, text, lines = max(1, round(minutes)), "Making validation images", []
    try:
        yield Progress(0, total, text, f"in {folder}")
        while training.running or training.unread:
            line = training.next_line()
            if line is not None:
                lines.append(line)
                text = line
            yield Progress(min(training.minutes, total), total, text, line, _POLL_INTERVAL)
    finally:
        training.end()
    if training.failed:
        raise CartsError(f"The network could not be adapted: {' '.join(lines[-3:]) or 'training ended early'}")
    yield Progress(total, total, _outcome(folder) or (lines[-1] if lines else ""))


def _outcome(folder: Path) -> str:
    """Gain of an adaptation, or the metrics that became worse; empty if there is no report."""
    try:
        report = parse_json(read_text(folder / "report" / "fits.json", VALUES))
        worse, gain = "; ".join(report["worse"]), str(report["gain"])
    except (OSError, ValueError, TypeError, KeyError):
        return ""
    return f"rejected because of worse results: {worse}" if worse else gain


class _Training:
    """Child process that trains a network."""

    def __init__(self, arguments: list[str]) -> None:
        self._began = time.monotonic()
        # Busy-waiting threads would slow down the page.
        output = {"PYTHONUNBUFFERED": "1", "NO_COLOR": "1", "OMP_WAIT_POLICY": "PASSIVE"}
        environment = {**os.environ, **output, PARENT: str(os.getpid())}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "carts_core.cli", "train", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment,
        )
        self._lines: SimpleQueue[str] = SimpleQueue()
        self._reader = threading.Thread(target=self._read, name="carts-training", daemon=True)
        self._reader.start()

    @property
    def running(self) -> bool:
        """Whether more output may follow."""
        return self._reader.is_alive() or self._process.poll() is None

    @property
    def unread(self) -> bool:
        """Whether there are unread lines."""
        return not self._lines.empty()

    @property
    def failed(self) -> bool:
        """Whether the process ended with an error."""
        return self._process.wait() != 0

    @property
    def minutes(self) -> int:
        """Minutes since the start."""
        return int((time.monotonic() - self._began) / 60)

    def next_line(self) -> str | None:
        """The next unread line; None if there is none."""
        with suppress(Empty):
            return self._lines.get_nowait()
        return None

    def end(self) -> None:
        """Ask the process to save and end, without waiting for the end."""
        if self._process.poll() is None:
            self._process.terminate()
            # No thread can be started while the interpreter ends; the process then ends with its parent.
            if not sys.is_finalizing():
                threading.Thread(target=self._reap, daemon=True).start()

    def _reap(self) -> None:
        try:
            self._process.wait(_CHECKPOINT_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                if line.strip():
                    self._lines.put(line.strip()[:500])
