"""What every intent does to the state. Runs on the worker's thread alone, knows neither threads nor widgets."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import singledispatchmethod
from typing import Any

import numpy as np

from carts_core.errors import CartsError, SettingsError
from carts_core.export import file_name
from carts_viewer import intents as ask
from carts_viewer.exporting import ZipExport, frame_mask
from carts_viewer.layers import Layer
from carts_viewer.picture import Painter
from carts_viewer.running import ActiveRun, OptimizerFactory
from carts_viewer.session import Session
from carts_viewer.state import Curves, ExportState, Maps, Phase, Pose, RunState, Scores, Source, ViewState

SPEEDS = (0.5, 60.0)
"""Slowest and fastest playing [frames/s]."""
LARGEST_PERTURBATION = 30.0
"""[deg and mm]."""
_REASONS = {
    "iterations": "Done, best iterate kept",
    "not optimized": "Evaluated only, as the solver says",
    "converged": "Converged",
    "cancelled": "Cancelled",
}

Deliver = Callable[[int, str, bytes], None]
"""Sends a file to a tab: client id, file name, content."""


class Controller:
    """Holds the state and changes it: at once in `handle`, bit by bit in `advance`."""

    def __init__(
        self, state: ViewState, session: Session, painter: Painter, optimizers: OptimizerFactory, deliver: Deliver
    ) -> None:
        self.state = state
        self._session = session
        self._painter = painter
        self._optimizers = optimizers
        self._deliver = deliver
        self._run: ActiveRun | None = None
        self._export: tuple[ZipExport, int] | None = None
        self._next_frame_at = 0.0
        self._drag: tuple[object, tuple[str, int] | None] = (object(), None)
        self._started_at: Pose | None = None

    def fail(self, error: Exception, *, stop: bool) -> None:
        """Show an error to the user.

        Args:
            error: What happened.
            stop: Stop whatever is going on; for errors of what is going on itself.
        """
        text = str(error) if isinstance(error, CartsError) else f"{type(error).__name__}: {error}"
        self._set(error=text, busy=None)
        if stop:
            self._end_run("Stopped by an error")
            self._export = None
            self._set(playing=False, export=None)

    def say(self, text: str | None) -> None:
        """Tell the user what is being prepared; None when nothing is."""
        self._set(busy=text)

    def patience(self) -> float | None:
        """How long nothing needs to be done unless somebody asks [s]; None for ever."""
        if self.state.run.phase is Phase.RUNNING or self._export is not None:
            return 0.0
        if self.state.playing:
            return max(0.0, self._next_frame_at - time.monotonic())
        return None

    def advance(self) -> None:
        """Do one bit of what is going on: an iteration, a frame of an export, the next frame of playing."""
        if self.state.run.phase is Phase.RUNNING:
            self._iterate()
        if self._export is not None:
            self._export_bit(*self._export)
        if self.state.playing and time.monotonic() >= self._next_frame_at:
            self._next_frame_at = time.monotonic() + 1.0 / self.state.fps
            self._show(index=(self.state.index + 1) % len(self._session.sequence))

    def score(self) -> None:
        """Compare the pose with the truth, if that was not done yet."""
        state = self.state
        if state.scores is None:
            self._set(scores=self._painter.scores(state.pose.scene, state.frame, state.camera))

    def map(self) -> None:
        """Compute what the chosen layer shows beyond the pose, if that is not there yet."""
        state = self.state
        if state.layer not in (Layer.ATTENTION, Layer.SIMILARITY):
            return
        if state.maps is not None and state.camera in state.maps.cameras:
            return
        try:
            run = self._make_run((state.camera,))
            iterate = run.step()
        except CartsError:
            # Without weights, say, there is nothing to show, and trying again with every picture would not help.
            self._set(layer=Layer.MASK)
            raise
        self._set(maps=None if iterate is None else Maps(iterate, run.cameras), busy=None)

    # ---- Intents ---------------------------------------------------------------------------------------------------

    @singledispatchmethod
    def handle(self, intent: ask.Intent) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise CartsError(f"The viewer does not know what to do with {type(intent).__name__}; this is a bug.")

    @handle.register
    def _(self, intent: ask.Drawn) -> None:
        del intent  # Nothing to do: it has woken the worker, which now may send the next overlay.

    @handle.register
    def _(self, intent: ask.Refresh) -> None:
        self._set()

    @handle.register
    def _(self, intent: ask.ShowFrame) -> None:
        self._set(playing=False)
        self._show(index=intent.index)

    @handle.register
    def _(self, intent: ask.MoveFrame) -> None:
        self._set(playing=False)
        self._show(index=self.state.index + intent.by)

    @handle.register
    def _(self, intent: ask.Play) -> None:
        on = not self.state.playing if intent.on is None else intent.on
        self._next_frame_at = time.monotonic()
        self._set(playing=on)

    @handle.register
    def _(self, intent: ask.SetSpeed) -> None:
        self._set(fps=_clamped(intent.fps, *SPEEDS))

    @handle.register
    def _(self, intent: ask.ShowDomain) -> None:
        self._show(domain=intent.domain)

    @handle.register
    def _(self, intent: ask.ShowCamera) -> None:
        self._show(camera=intent.camera)

    @handle.register
    def _(self, intent: ask.ShowLayer) -> None:
        self._set(layer=intent.layer)

    @handle.register
    def _(self, intent: ask.SetOpacity) -> None:
        self._set(opacity=_clamped(intent.opacity, 0.0, 1.0))

    @handle.register
    def _(self, intent: ask.SetJoint) -> None:
        scene = self._session.with_joint(self.state.pose.scene, intent.arm, intent.joint, _finite(intent.value))
        # All events of one joint until it is let go of are one step of undo.
        self._drag = (self._drag[0], (intent.arm, intent.joint))
        self._edit(Pose(scene, Source.EDITED), merges=self._drag)

    @handle.register
    def _(self, intent: ask.Released) -> None:
        self._drag = (object(), None)

    @handle.register
    def _(self, intent: ask.BackToMeasured) -> None:
        measured = self._session.measured(self.state.frame)
        if intent.arm is None:
            self._edit(measured)
            return
        joints = self._session.joints(measured.scene)[intent.arm]
        self._edit(Pose(self._session.with_joints(self.state.pose.scene, {intent.arm: joints}), Source.EDITED))

    @handle.register
    def _(self, intent: ask.Perturb) -> None:
        degrees = _clamped(intent.degrees, 0.0, LARGEST_PERTURBATION)
        self._edit(
            Pose(self._session.perturbed(self.state.pose.scene, self.state.index, degrees, intent.seed), Source.EDITED)
        )

    @handle.register
    def _(self, intent: ask.Undo) -> None:
        self._end_run("Stopped by undo")
        index = self._session.undo()
        if index is not None:
            self._show(index=index, again=True)

    @handle.register
    def _(self, intent: ask.Run) -> None:
        if self._run is None:
            self._start_run()
        self._set_run(phase=Phase.RUNNING, reason=None)

    @handle.register
    def _(self, intent: ask.Pause) -> None:
        if self.state.run.phase is Phase.RUNNING:
            self._set_run(phase=Phase.PAUSED)

    @handle.register
    def _(self, intent: ask.RunOrPause) -> None:
        self.handle(ask.Pause() if self.state.run.phase is Phase.RUNNING else ask.Run())

    @handle.register
    def _(self, intent: ask.Step) -> None:
        if self._run is None:
            self._start_run()
            self._iterate()
        self._set_run(phase=Phase.PAUSED, reason=None)
        self._iterate()

    @handle.register
    def _(self, intent: ask.Reset) -> None:
        self._end_run(None)
        self._set(run=RunState())
        if self._started_at is not None:
            self._edit(self._started_at)

    @handle.register
    def _(self, intent: ask.SetSetting) -> None:
        try:
            settings = replace(self.state.settings, **{intent.name: intent.value})
        except SettingsError as error:
            # Half-typed numbers are often out of range, so this is no occasion for an alarm; Run refuses later.
            self._set(settings_error=str(error))
            return
        self._end_run("Settings changed; Run starts anew from here")
        self._set(settings=settings, settings_error=None, maps=None)

    @handle.register
    def _(self, intent: ask.SetFreeJoint) -> None:
        name = f"{intent.arm}/{intent.joint}"
        locked = {*self.state.free.locked_joints} - {name} if intent.on else {*self.state.free.locked_joints, name}
        self._set_free(locked_joints=tuple(sorted(locked)))

    @handle.register
    def _(self, intent: ask.SetFreeGroup) -> None:
        if intent.group not in ("base_frames", "extrinsics", "intrinsics"):
            raise SettingsError(f"There is no group of parameters called {intent.group!r}.")
        self._set_free(**{intent.group: intent.on})

    @handle.register
    def _(self, intent: ask.SetCameras) -> None:
        self._end_run("Cameras changed; Run starts anew from here")
        self._set(every_camera=intent.every)

    @handle.register
    def _(self, intent: ask.ExportMask) -> None:
        state = self.state
        name = file_name(f"{self._session.sequence.name}_{state.frame.frame_id}_{state.camera}") + ".png"
        self._deliver(intent.client_id, name, frame_mask(self._painter, state.pose, state.camera))

    @handle.register
    def _(self, intent: ask.ExportAll) -> None:
        export = ZipExport(self._session, self._painter)
        self._export = (export, intent.client_id)
        self._set(export=ExportState(0, export.total))

    @handle.register
    def _(self, intent: ask.CancelExport) -> None:
        self._export = None
        self._set(export=None)

    @handle.register
    def _(self, intent: ask.DismissError) -> None:
        self._set(error=None)

    # ---- Showing a frame -------------------------------------------------------------------------------------------

    def _show(
        self, *, index: int | None = None, domain: str | None = None, camera: str | None = None, again: bool = False
    ) -> None:
        """Go to another frame, domain or camera; out of range is clamped, an unknown name is refused."""
        state = self.state
        sequence = self._session.sequence
        index = state.index if index is None else min(max(int(index), 0), len(sequence) - 1)
        domain = _one_of(domain, state.domain, sequence.domains, "domain")
        camera = _one_of(camera, state.camera, [own.name for own in sequence.scene.cameras], "camera")
        if not again and (index, domain, camera) == (state.index, state.domain, state.camera):
            return
        if (index, domain) != (state.index, state.domain) or (camera != state.camera and not state.every_camera):
            self._end_run("Stopped: another image is shown")
        frame = self._session.frame(index, domain, camera)
        if index != state.index:
            self._started_at = None
            self._set(run=RunState())
        self._set(index=index, domain=domain, camera=camera, frame=frame, error=None)
        self._pose(self._session.pose(frame))

    def _edit(self, pose: Pose, merges: object | None = None) -> None:
        """Give the shown frame another pose by hand."""
        self._end_run("Stopped: the pose was changed by hand")
        self._session.correct(self.state.index, pose, merges=merges)
        self._pose(pose)

    def _pose(self, pose: Pose, maps: Maps | None = None) -> None:
        self._set(pose=pose, scores=None, maps=maps, undoable=self._session.undoable)

    # ---- The optimizer ---------------------------------------------------------------------------------------------

    def _make_run(self, cameras: tuple[str, ...]) -> ActiveRun:
        state, scene = self.state, self._session.scene
        optimizer = self._optimizers.make(state.index, state.domain, cameras, state.pose, state.settings, state.free)
        return ActiveRun(optimizer, scene, state.pose, cameras)

    def _start_run(self) -> None:
        if self.state.settings_error is not None:
            raise SettingsError(self.state.settings_error)
        names = tuple(camera.name for camera in self._session.scene.cameras)
        self._run = self._make_run(names if self.state.every_camera else (self.state.camera,))
        self._started_at = self.state.pose
        self._set(run=RunState(Phase.RUNNING), playing=False, error=None, busy=None)

    def _iterate(self) -> None:
        run = self._run
        if run is None:
            return
        iterate = run.step()
        if iterate is None:
            best, reason = run.best(), run.stop_reason
            if best is not None:
                self._accept(run, best)
            self._end_run(_REASONS.get(reason or "", reason))
            return
        self._accept(run, iterate)
        self.score()
        curves = self.state.run.curves
        self._set_run(
            curves=Curves(
                (*curves.loss, float(iterate.loss)),
                (*curves.scores, self.state.scores or Scores()),
                (*curves.seconds, float(iterate.seconds)),
            )
        )

    def _accept(self, run: ActiveRun, iterate: Any) -> None:
        """Show an iterate and remember it as the frame's pose; all iterates of a run are one step of undo."""
        pose = run.pose(iterate)
        self._session.correct(self.state.index, pose, merges=run)
        self._pose(pose, Maps(iterate, run.cameras))

    def _end_run(self, reason: str | None) -> None:
        """Drop the optimizer; its curves stay until the next run."""
        if self._run is not None:
            self._run = None
            self._set_run(phase=Phase.IDLE, reason=reason)

    # ---- Small things ----------------------------------------------------------------------------------------------

    def _export_bit(self, export: ZipExport, client_id: int) -> None:
        if export.step():
            self._set(export=ExportState(export.done, export.total))
            return
        self._export = None
        self._deliver(client_id, file_name(self._session.sequence.name) + ".zip", export.finish())
        self._set(export=None)

    def _set_free(self, **changes: Any) -> None:
        self._end_run("Free parameters changed; Run starts anew from here")
        self._set(free=replace(self.state.free, **changes), maps=None)

    def _set_run(self, **changes: Any) -> None:
        self._set(run=replace(self.state.run, **changes))

    def _set(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise CartsError(f"{value} is not a number that a control can be set to.")
    return float(value)


def _clamped(value: float, low: float, high: float) -> float:
    return float(np.clip(_finite(value), low, high))


def _one_of(asked: str | None, now: str, known: Any, what: str) -> str:
    if asked is None:
        return now
    if asked not in known:
        raise CartsError(f"There is no {what} called {asked!r}; this sequence has: {', '.join(known)}.")
    return asked
