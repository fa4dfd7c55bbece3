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
from carts_core.project import Edits, Figures, Key, Provenance, Review, ReviewState, Source
from carts_core.scene import SceneState
from carts_viewer import intents as ask
from carts_viewer.annotating import Annotator
from carts_viewer.exporting import ZipExport, frame_mask
from carts_viewer.layers import Layer
from carts_viewer.painting import Brushwork, Painting
from carts_viewer.picture import Painter
from carts_viewer.running import ActiveRun, OptimizerFactory
from carts_viewer.session import Session
from carts_viewer.state import Curves, ExportState, Maps, Phase, RunState, Scores, ViewState

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
        self.session = session
        self._editor = session.editor
        self.painter = painter
        self._optimizers = optimizers
        self._deliver = deliver
        self._run: ActiveRun | None = None
        self._export: tuple[ZipExport, int] | None = None
        self._next_frame_at = 0.0
        self._annotator = Annotator(self)
        self._brushwork = Brushwork(self)
        self._loss: float | None = None
        self._before_run: Edits | None = None

    def fail(self, error: Exception, *, stop: bool) -> None:
        """Show an error to the user.

        Args:
            error: What happened.
            stop: Stop whatever is going on; for errors of what is going on itself.
        """
        text = str(error) if isinstance(error, CartsError) else f"{type(error).__name__}: {error}"
        self.change(error=text, busy=None)
        if stop:
            self.end_run("Stopped by an error", save=False)
            self._export = None
            self.change(playing=False, export=None)

    def say(self, text: str | None) -> None:
        """Tell the user what is being prepared; None when nothing is."""
        self.change(busy=text)

    def patience(self) -> float | None:
        """How long nothing needs to be done unless somebody asks [s]; None for ever."""
        if self.state.run.phase is Phase.RUNNING or self._export is not None:
            return 0.0
        if self.state.playing:
            return max(0.0, self._next_frame_at - time.monotonic())
        return None

    def overdue_in(self) -> float | None:
        """How long until `advance` has to save a gesture that nobody has ended [s]; None: nothing to save."""
        return self._editor.overdue_in()

    def advance(self) -> None:
        """Do one bit of what is going on: an iteration, a frame of an export, the next frame of playing."""
        if self.state.run.phase is Phase.RUNNING:
            self._iterate()
        if self._export is not None:
            self._export_bit(*self._export)
        if self.state.playing and time.monotonic() >= self._next_frame_at:
            self._next_frame_at = time.monotonic() + 1.0 / self.state.fps
            self.show(index=(self.state.index + 1) % len(self.session.sequence))
        if self.overdue_in() == 0.0:
            self.save()

    def score(self) -> None:
        """Compare the pose with the truth, if that was not done yet; the project keeps the first figures it gets."""
        state = self.state
        if state.scores is not None:
            return
        scores = self.painter.scores(state.pose.scene, state.frame, state.camera, state.mask_correction)
        self.change(scores=scores)
        project = self._editor.project
        known = scores.dice is None or state.unsaved or project.state.figures(state.index) is not None
        if project.writable and not known and not state.playing:
            project.record_figures({state.index: Figures(dice=scores.dice)}, project.state)
            self.change(project=self._editor.view)

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
            self.change(layer=Layer.MASK)
            raise
        self.change(maps=None if iterate is None else Maps(iterate, run.cameras), busy=None)

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
        self.change()

    @handle.register
    def _(self, intent: ask.ShowFrame) -> None:
        self.change(playing=False)
        self.show(index=intent.index)

    @handle.register
    def _(self, intent: ask.MoveFrame) -> None:
        self.change(playing=False)
        self.show(index=self.state.index + intent.by)

    @handle.register
    def _(self, intent: ask.Play) -> None:
        on = not self.state.playing if intent.on is None else intent.on
        self._next_frame_at = time.monotonic()
        self.change(playing=on)

    @handle.register
    def _(self, intent: ask.SetSpeed) -> None:
        self.change(fps=_clamped(intent.fps, *SPEEDS))

    @handle.register
    def _(self, intent: ask.ShowDomain) -> None:
        self.show(domain=intent.domain)

    @handle.register
    def _(self, intent: ask.ShowCamera) -> None:
        self.show(camera=intent.camera)

    @handle.register
    def _(self, intent: ask.ShowLayer) -> None:
        self.change(layer=intent.layer)

    @handle.register
    def _(self, intent: ask.SetOpacity) -> None:
        self.change(opacity=_clamped(intent.opacity, 0.0, 1.0))

    @handle.register
    def _(self, intent: ask.Annotation) -> None:
        self._annotator.handle(intent)

    @handle.register
    def _(self, intent: Painting) -> None:
        self._brushwork.handle(intent)

    @handle.register
    def _(self, intent: ask.SetJoint) -> None:
        value = _finite(intent.value)
        scene = self.session.with_joint(self.state.pose.scene, intent.arm, intent.joint, value)
        self.change(joint=(intent.arm, intent.joint))
        # All events of one joint until it is let go of are one step of undo.
        self.edit(f"Move {self._joint_name()}", scene, gesture=(ask.SetJoint, intent.arm, intent.joint))

    @handle.register
    def _(self, intent: ask.ChooseJoint) -> None:
        joints = [(arm.name, joint) for arm in self.session.scene.arms for joint in range(len(arm.robot.joint_names))]
        following = joints[(joints.index(self.state.joint or joints[0]) + 1) % len(joints)]
        chosen = intent.joint or following
        if chosen not in joints:
            raise CartsError(f"There is no joint {chosen!r}.")
        self.change(joint=chosen)

    @handle.register
    def _(self, intent: ask.Nudge) -> None:
        arm, joint = self.state.joint or (self.session.scene.arms[0].name, 0)
        by = _clamped(intent.by, -LARGEST_PERTURBATION, LARGEST_PERTURBATION)
        step = math.radians(by) if self.session.joint_range(arm, joint).revolute else by / 1e3
        now = self.session.joints(self.state.pose.scene)[arm][joint]
        scene = self.session.with_joint(self.state.pose.scene, arm, joint, now + step)
        self.edit(f"Nudge {self._joint_name()}", scene)

    @handle.register
    def _(self, intent: ask.Released) -> None:
        self._annotator.released()
        # A run is no gesture of a hand, so nobody's letting go of something ends it.
        if self._run is None:
            self.save()

    @handle.register
    def _(self, intent: ask.BackToMeasured) -> None:
        self.end_run("Stopped: the pose was changed by hand")
        names = [arm.name for arm in self.session.scene.arms] if intent.arm is None else [intent.arm]
        self.stage("Back to measured", {Key.joints(self.state.index, name): None for name in names})

    @handle.register
    def _(self, intent: ask.Perturb) -> None:
        degrees = _clamped(intent.degrees, 0.0, LARGEST_PERTURBATION)
        scene = self.session.perturbed(self.state.pose.scene, self.state.index, degrees, intent.seed)
        self.edit(f"Perturb by {degrees:g}°", scene)

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
        if self._run is not None:
            # Nothing of the run was saved yet, so there is nothing to take back.
            self._editor.drop()
        self.end_run(None)
        self.change(run=RunState())
        if self._before_run is not None:
            self.stage("Reset to the start of the run", self._before_run)

    @handle.register
    def _(self, intent: ask.SetSetting) -> None:
        try:
            if intent.name == "loss":
                settings = self.state.settings.with_loss(intent.value)
            else:
                settings = replace(self.state.settings, **{intent.name: intent.value})
        except SettingsError as error:
            # Half-typed numbers are often out of range, so this is no occasion for an alarm; Run refuses later.
            self.change(settings_error=str(error))
            return
        self.end_run("Settings changed; Run starts anew from here")
        self.change(settings=settings, settings_error=None, maps=None)

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
        self.end_run("Cameras changed; Run starts anew from here")
        self.change(every_camera=intent.every)

    @handle.register
    def _(self, intent: ask.ExportMask) -> None:
        state = self.state
        name = file_name(f"{self.session.sequence.name}_{state.frame.frame_id}_{state.camera}") + ".png"
        self._deliver(intent.client_id, name, frame_mask(self.painter, state.pose, state.camera, state.mask_correction))

    @handle.register
    def _(self, intent: ask.ExportAll) -> None:
        export = ZipExport(self.session, self.painter)
        self._export = (export, intent.client_id)
        self.change(export=ExportState(0, export.total))

    @handle.register
    def _(self, intent: ask.CancelExport) -> None:
        self._export = None
        self.change(export=None)

    @handle.register
    def _(self, intent: ask.DismissError) -> None:
        self.change(error=None)

    # ---- Showing a frame -------------------------------------------------------------------------------------------

    def show(
        self, *, index: int | None = None, domain: str | None = None, camera: str | None = None, again: bool = False
    ) -> None:
        """Go to another frame, domain or camera; out of range is clamped, an unknown name is refused.

        Args:
            index: of the frame.
            domain: its name.
            camera: its name.
            again: also if nothing of these changes.

        Raises:
            CartsError: a name is unknown, the image is not usable, or an unfinished edit could not be saved.
        """
        state = self.state
        sequence = self.session.sequence
        index = state.index if index is None else min(max(int(index), 0), len(sequence) - 1)
        domain = _one_of(domain, state.domain, sequence.domains, "domain")
        camera = _one_of(camera, state.camera, [own.name for own in sequence.scene.cameras], "camera")
        if not again and (index, domain, camera) == (state.index, state.domain, state.camera):
            return
        if (index, domain) != (state.index, state.domain) or (camera != state.camera and not state.every_camera):
            self.end_run("Stopped: another image is shown")
        frame = self.session.frame(index, domain, camera)
        if index != state.index:
            self.save()
            # What a project that takes no edits could not save was for looking at only.
            self._editor.drop()
            self._before_run, self._loss = None, None
            self.change(run=RunState(), keypoints=replace(state.keypoints, pins=(), residuals=()))
        self.change(index=index, domain=domain, camera=camera, frame=frame, scores=None, maps=None, error=None)
        self.refresh()

    # ---- Editing ---------------------------------------------------------------------------------------------------

    def edit(
        self, name: str, scene: SceneState, *, gesture: object = None, source: Source = Source.HAND, pins: bool = False
    ) -> None:
        """Give the shown frame another pose.

        Args:
            name: of the step in the history.
            scene: the pose.
            gesture: edits of the same gesture are one step, saved when it ends; None: this is the whole gesture.
            source: who made it.
            pins: whether the pose is what pins say; otherwise they are forgotten.

        Raises:
            ProjectError: it could not be saved.
        """
        self.end_run("Stopped: the pose was changed by hand")
        if not pins:
            self.forget_pins()
        self.stage(name, self.session.edits(self.state.frame, scene, Provenance(source)), gesture=gesture)

    def stage(
        self,
        name: str,
        edits: Edits,
        *,
        gesture: object = None,
        loss: float | None = None,
        maps: Maps | None = None,
        frame: int | None = None,
    ) -> None:
        """Change the project; arguments and errors as `edit`, for any edits.

        Args:
            name: of the step in the history.
            edits: what changes.
            gesture: see `edit`.
            loss: the optimizer's, at the new pose.
            maps: what the optimizer saw there.
            frame: index of the frame that changes; the shown one if None.
        """
        if self._editor.gesture != gesture:
            self.save()
        self._loss = loss
        frame_id = self.session.sequence.frame_ids[self.state.index if frame is None else frame]
        self._editor.draft(f"{name}, frame {frame_id}", edits, gesture or object())
        self.refresh(maps)
        if gesture is None:
            self.save()

    def mark(self, name: str, review: Review, *, gesture: object = None) -> None:
        """Say something about the shown frame, which ends a run. Arguments and errors as `edit`."""
        self.end_run("Stopped: the frame was reviewed")
        self.stage(name, {Key.review(self.state.index): review}, gesture=gesture)

    def save(self) -> None:
        """Save the gesture under way as one step, as far as there is one.

        Raises:
            ProjectError: it could not be saved.
        """
        if not self._editor.unsaved:
            return
        index, figures = self.state.index, {}
        if self._editor.view.figures(index) is None:
            self.score()
            found = Figures(self._loss, self.state.scores.dice if self.state.scores else None)
            figures = {} if found == Figures() else {index: found}
        self._editor.save(figures)
        self.change(project=self._editor.view, unsaved=self._editor.unsaved)

    def refresh(self, maps: Maps | None = None) -> None:
        """Bring the state up to date with the project; a pose that is the same keeps its scores and maps."""
        before, pose = self.state, self.session.pose(self.state.frame)
        if not pose.equals(self.state.pose):
            self.change(pose=pose, scores=None, maps=None)
        self.change(maps=maps or self.state.maps, project=self._editor.view, unsaved=self._editor.unsaved)
        if self.state.mask_correction != before.mask_correction:
            self.change(scores=None)
        if self.state.ignore_region != before.ignore_region:
            self.change(maps=None)

    def forget_pins(self) -> None:
        """Drop what was said about where keypoints are."""
        if self.state.keypoints.pins:
            self.change(keypoints=replace(self.state.keypoints, pins=(), residuals=()))

    def _joint_name(self) -> str:
        arm, joint = self.state.joint or (self.session.scene.arms[0].name, 0)
        return f"{arm} {self.session.joint_range(arm, joint).joint.removesuffix('_joint').replace('_', ' ')}"

    # ---- The optimizer ---------------------------------------------------------------------------------------------

    def _make_run(self, cameras: tuple[str, ...]) -> ActiveRun:
        state, scene = self.state, self.session.scene
        ignore = self.session.ignored(state.index, cameras)
        optimizer = self._optimizers.make(
            state.index, state.domain, cameras, state.pose, state.settings, state.free, ignore
        )
        provenance = self._optimizers.provenance(cameras, state.settings, state.free)
        return ActiveRun(optimizer, scene, state.pose, cameras, provenance)

    def _start_run(self) -> None:
        if self.state.settings_error is not None:
            raise SettingsError(self.state.settings_error)
        names = tuple(camera.name for camera in self.session.scene.cameras)
        self._run = self._make_run(names if self.state.every_camera else (self.state.camera,))
        self.save()
        self.forget_pins()
        self._before_run = self.session.saved(self.state.index)
        self.change(run=RunState(Phase.RUNNING), playing=False, error=None, busy=None)

    def _iterate(self) -> None:
        run = self._run
        if run is None:
            return
        iterate = run.step()
        if iterate is None:
            best, reason = run.best(), run.stop_reason
            if best is not None:
                self._accept(run, best)
            self.end_run(_REASONS.get(reason or "", reason))
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
        """Show an iterate as the frame's pose; all iterates of a run are one step of undo."""
        index = self.state.index
        edits = self.session.edits(self.state.frame, run.pose(iterate).scene, run.provenance)
        review = self._editor.project.state.review(index)
        if review.state is ReviewState.UNTOUCHED:
            edits[Key.review(index)] = Review(ReviewState.OPTIMIZED, review.note)
        self.stage("Optimize", edits, gesture=run, loss=float(iterate.loss), maps=Maps(iterate, run.cameras))

    def end_run(self, reason: str | None, *, save: bool = True) -> None:
        """Drop the optimizer and save where it is; its curves stay until the next run.

        Raises:
            ProjectError: it could not be saved.
        """
        if self._run is not None:
            self._run = None
            self._set_run(phase=Phase.IDLE, reason=reason)
            if save:
                self.save()

    # ---- Small things ----------------------------------------------------------------------------------------------

    def _export_bit(self, export: ZipExport, client_id: int) -> None:
        if export.step():
            self.change(export=ExportState(export.done, export.total))
            return
        self._export = None
        self._deliver(client_id, file_name(self.session.sequence.name) + ".zip", export.finish())
        self.change(export=None)

    def _set_free(self, **changes: Any) -> None:
        self.end_run("Free parameters changed; Run starts anew from here")
        self.change(free=replace(self.state.free, **changes), maps=None)

    def _set_run(self, **changes: Any) -> None:
        self.change(run=replace(self.state.run, **changes))

    def change(self, **changes: Any) -> None:
        """Replace fields of the state."""
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
