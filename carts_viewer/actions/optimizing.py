"""The optimizer: runs on the shown frame, solver settings, and free parameters."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from carts_core.errors import CartsError, SettingsError
from carts_core.model.scene import SceneState
from carts_core.optimization import Iterate
from carts_core.project import Edits, FitVerdict, Key
from carts_core.project.values import WHOLE_PROJECT
from carts_core.recording import Frame
from carts_core.settings import SolverName, SurfaceSolver
from carts_core.settings import solver as named_solver
from carts_core.settings.serialization import changed
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler
from carts_viewer.jobs.choices import Observed
from carts_viewer.jobs.optimizers import ActiveRun, OptimizerFactory, provenance, wait_for
from carts_viewer.jobs.solver import Advanced, Ended, Fit, FrameTask, RefineTask, Started
from carts_viewer.jobs.solver_process import Reply, SolverStopped
from carts_viewer.picture.layers import Layer
from carts_viewer.state import PRESETS, Curves, Maps, Phase, Pose, RefinedMasks, RunState, Scores

_REASONS = {
    "iterations": "Done: the best iteration is the result",
    "not optimized": "Evaluated only: this solver does not optimize",
    "converged": "Ended: no step reduces the loss further",
    "failed": "Ended: the image contradicts the result",
    "start kept": "Initial pose kept: the optimized pose does not fit much better",
    "cancelled": "Cancelled",
}


@dataclass(frozen=True)
class _Request:
    """Request of maps or refined masks."""

    inputs: tuple[object, ...]
    """Values of the state that the result depends on."""
    reply: Reply[Any]
    show: Callable[[Any], None]


@dataclass(frozen=True)
class _Check:
    """Request of a verdict on a pose."""

    frame: Frame
    pose: Pose
    reply: Reply[Fit]


class OptimizingHandler(Handler):
    """Handler that runs the optimizer, one iteration at a time, and shows the replies of the solver."""

    def __init__(self, context: Context, optimizers: OptimizerFactory) -> None:
        super().__init__(context)
        context.run = self
        self._optimizers = optimizers
        self._run: ActiveRun | None = None
        self._mapping: _Request | None = None
        self._check: _Check | None = None
        self._before: Edits | None = None
        """Edits that restore the frame to the start of the last run."""
        self._made: Edits = {}
        """Newest edits of the last run."""

    @property
    def active(self) -> bool:
        """Whether a run is in progress or paused."""
        return self._run is not None

    @property
    def computing(self) -> bool:
        """Whether the next iterate of the run is due, so that its draft is unfinished."""
        return self._run is not None and self._due(self._run)

    def wait_time(self) -> float | None:
        """Time until the next iteration or reply is due [s]; None if there is none."""
        run, waits = self._run, []
        if run is not None and self._due(run):
            waits.append(wait_for(run.reply))
        waits += [wait_for(asked.reply) for asked in (self._mapping, self._check) if asked is not None]
        return min(waits, default=None)

    def advance(self) -> None:
        """Perform an iteration, if one is due, and show the replies of the solver.

        Raises:
            CartsError: the solver has failed.
        """
        self._iterate()
        self._take_check()
        self._take_maps()

    def end(self, reason: str | None, *, save: bool = True) -> None:
        """End the run and save its pose; its curves are kept until the next run.

        Raises:
            ProjectError: the pose could not be saved.
        """
        if self._context.state.run.base_frame_gain is not None:
            self._set(base_frame_gain=None)
        if self._run is not None:
            self._run.steps.close()
            self._run = None
            self._set(phase=Phase.IDLE, reason=reason)
            if save:
                self._context.save()

    def forget(self) -> None:
        """Discard the start of the run when another frame is shown."""
        self._before = None

    def map(self) -> None:
        """Request the maps or refined masks of the chosen layer, if they are missing.

        Raises:
            CartsError: the maps cannot be computed.
        """
        state = self._context.state
        if state.layer is Layer.REFINED:
            self._refine()
        if state.layer not in (Layer.ATTENTION, Layer.SIMILARITY):
            return
        if self._run is not None and state.camera in self._run.cameras:
            return
        if state.maps is not None and state.camera in state.maps.cameras:
            return
        cameras = (state.camera,)

        def show(iterate: Iterate | None) -> None:
            assert iterate is not None, "the first iterate is the start"
            self._context.change(maps=Maps(iterate, cameras, of_run=False))

        inputs = state.frame, state.pose, cameras, state.settings, state.free, state.observed
        self._request(inputs, lambda: self._optimizers.compare(self._task(cameras)), show)

    def _refine(self) -> None:
        """Refine the rendered masks of the shown cameras; during a gesture or a run, masks are shown as rendered."""
        state, context, session = self._context.state, self._context, self._session
        if state.unsaved or state.run.phase is Phase.RUNNING:
            return
        pose, frame = state.pose.scene, state.frame
        cameras = [state.camera] if not state.beside else [*frame.images]
        if all(state.refined_mask(pose, camera) is not None for camera in cameras):
            return
        ignored = {camera: state.ignore_region_of(camera) for camera in cameras}

        def task() -> RefineTask:
            regions = {camera: region.region() for camera, region in ignored.items() if region is not None}
            rendered = {camera: context.renderer.mask(pose, camera) for camera in cameras}
            every = tuple(camera.name for camera in session.scene.cameras)
            return RefineTask(session.sequence, state.index, state.domain, every, pose, rendered, regions)

        self._request(
            (frame, pose, *ignored.items()),
            lambda: self._optimizers.refine(task()),
            lambda masks: context.change(refined=RefinedMasks(frame, pose, ignored, masks)),
        )

    def _request(self, inputs: tuple[object, ...], ask: Callable[[], Reply[Any]], show: Callable[[Any], None]) -> None:
        """Request the data of the shown layer, unless already requested; one request is pending at a time."""
        if self._mapping is None:
            self._mapping = _Request(inputs, ask(), show)
        elif self._mapping.reply.done and not _same(self._mapping.inputs, inputs):
            self._mapping = _Request(inputs, ask(), show)
        self._take_maps(inputs)

    def _take_maps(self, inputs: tuple[object, ...] | None = None) -> None:
        """Show the maps that have arrived; those for other `inputs` are dropped."""
        asked = self._mapping
        if asked is None or not asked.reply.done:
            return
        if inputs is None:
            # `map` calls this method again with the current inputs, if the layer still shows maps.
            self.map()
            self._mapping = None if self._mapping is asked else self._mapping
            return
        self._mapping = None
        if _same(asked.inputs, inputs):
            try:
                asked.show(asked.reply.result())
            except CartsError:
                # The layer is changed, since otherwise the request would be repeated for every picture.
                self._context.change(layer=Layer.MASK)
                raise
            self._context.change(busy=None)

    # ---- Intents ---------------------------------------------------------------------------------------------------

    def _on_Run(self, intent: intents.Run) -> None:
        if self._run is None:
            self._start()
        self._set(phase=Phase.RUNNING, reason=None)
        if self._run is not None and self._run.provenance is None:
            self._iterate()

    def _on_Pause(self, intent: intents.Pause) -> None:
        if self._context.state.run.phase is Phase.RUNNING:
            self._set(phase=Phase.PAUSED)

    def _on_RunOrPause(self, intent: intents.RunOrPause) -> None:
        self.handle(intents.Pause() if self._context.state.run.phase is Phase.RUNNING else intents.Run())

    def _on_Step(self, intent: intents.Step) -> None:
        if self._run is None:
            # The first iterate is the start.
            self._start().due = 1
        assert self._run is not None
        self._run.due += 1
        self._set(phase=Phase.PAUSED, reason=None)
        while self._run is not None and self._due(self._run) and self._run.request().done:
            self._iterate()

    def _on_Reset(self, intent: intents.Reset) -> None:
        if self._run is not None:
            # The poses of the run are an unsaved draft.
            self._session.editor.drop()
        self.end(None)
        self._context.change(run=RunState())
        if self._before is not None:
            # Calibration that the run did not change, or that was changed since, remains.
            made, view = self._made, self._session.editor.view
            edits = {
                key: value
                for key, value in self._before.items()
                if key.frame != WHOLE_PROJECT or (key in made and made[key] == view.get(key))
            }
            self._context.edit("Reset to the start of the run", edits)

    def _on_SetSetting(self, intent: intents.SetSetting) -> None:
        state = self._context.state
        settings, solver = state.settings, state.solver
        try:
            if intent.name == "solver":
                settings, solver = named_solver(intent.value), SolverName(intent.value)
            else:
                settings = changed(settings, {intent.name: intent.value}, "the solver")
        except SettingsError as error:
            # Half-typed numbers are often out of range, so the error is not shown before Run.
            self._context.change(settings_error=str(error), settings_field=intent.name)
            return
        self.end("Settings changed; Run starts from the current pose")
        self._context.change(settings=settings, solver=solver, settings_error=None, settings_field=None, maps=None)

    def _on_ResetSettings(self, intent: intents.ResetSettings) -> None:
        preset = PRESETS.get(intent.preset)
        if preset is None:
            raise SettingsError(f"Unknown preset {intent.preset!r}. Choose one of: {', '.join(PRESETS)}.")
        state = self._context.state
        settings = named_solver(state.solver)
        if isinstance(settings, SurfaceSolver):
            settings = replace(settings, **preset.changes(settings))
        self.end("Settings changed; Run starts from the current pose")
        self._context.change(settings=settings, settings_error=None, settings_field=None, maps=None)

    def _on_SetFreeJoint(self, intent: intents.SetFreeJoint) -> None:
        name = f"{intent.arm}/{intent.joint}"
        locked = {*self._context.state.free.locked_joints} - {name}
        self._set_free(locked_joints=tuple(sorted(locked if intent.on else {*locked, name})))

    def _on_SetFreeGroup(self, intent: intents.SetFreeGroup) -> None:
        if intent.group not in ("base_frames", "extrinsics", "intrinsics"):
            raise SettingsError(f"Unknown group of parameters {intent.group!r}.")
        self._set_free(**{intent.group: intent.on})

    def _on_SetCameras(self, intent: intents.SetCameras) -> None:
        self.end("Cameras changed; Run starts from the current pose")
        self._context.change(every_camera=intent.every)

    def _on_SetObserved(self, intent: intents.SetObserved) -> None:
        observed = Observed(intent.what, intent.masks)  # type: ignore[arg-type]
        self.end("Target changed; Run starts from the current pose")
        self._context.change(observed=observed, maps=None)

    # ---- The run ---------------------------------------------------------------------------------------------------

    def _task(self, cameras: tuple[str, ...]) -> FrameTask:
        state, every = self._context.state, [camera.name for camera in self._session.scene.cameras]
        target = self._session.target(state.observed)
        return FrameTask(
            self._session.sequence,
            state.index,
            state.domain,
            cameras,
            state.pose,
            state.settings,
            state.free,
            target.of_frame(state.index),
            self._session.ignored(state.index, every, target),
        )

    def _start(self) -> ActiveRun:
        if self._context.state.settings_error is not None:
            raise SettingsError(self._context.state.settings_error)
        if self._context.state.solving:
            raise CartsError("Many frames are being solved. Wait, or stop solving first.")
        self._context.save()
        self._before, self._made = self._session.saved(self._context.state.index), {}
        self._run = self._optimizers.run(replace(self._task(self._context.cameras), shown=True))
        return self._run

    def _due(self, run: ActiveRun) -> bool:
        """Whether the next result of the run is due."""
        return self._context.state.run.phase is Phase.RUNNING or run.due > 0

    def _iterate(self) -> None:
        """Take the next result of the run, if it is due and has arrived; otherwise request it."""
        run = self._run
        if run is None or not self._due(run) or not run.request().done:
            return
        reply, run.reply = run.request(), None
        try:
            found = reply.result()
        except SolverStopped:
            self.end("Stopped: the solver process has ended")
            raise
        except Exception:
            self._run = None
            self._set(phase=Phase.IDLE)
            raise
        match found:
            case Started():
                task = run.task
                run.provenance = provenance(found, task.cameras, task.settings, task.free, task.target)
                state = RunState(self._context.state.run.phase, start=task.pose.scene)
                warnings = found.warnings
                self._context.change(run=state, playing=False, error=None, busy=None, unfamiliar=warnings)
            case Advanced():
                self._show(run, found)
            case Ended():
                self._finish(run, found)

    def _show(self, run: ActiveRun, found: Advanced) -> None:
        iterate, run.due = found.iterate, max(run.due - 1, 0)
        self._accept(run, iterate)
        self._context.score()
        curves = self._context.state.run.curves
        self._set(
            curves=Curves(
                (*curves.loss, float(iterate.loss)),
                (*curves.stages, found.stage),
                False,
                (*curves.scores, self._context.state.scores or Scores()),
                (*curves.seconds, float(iterate.seconds)),
                found.best,
            )
        )

    def _finish(self, run: ActiveRun, found: Ended) -> None:
        if found.best is not None:
            self._accept(run, found.best, found.verdict)
            self._set(curves=replace(self._context.state.run.curves, loss=found.losses, comparable=True))
        self.end(_REASONS.get(found.stop_reason or "", found.stop_reason))
        self._set(base_frame_gain=found.base_frame_gain)

    def _on_Assess(self, intent: intents.Assess) -> None:
        self.end("Stopped: a check of the fit was started")
        self._optimizers.report("Comparing the pose with the images")
        state, cameras = self._context.state, tuple(camera.name for camera in self._session.scene.cameras)
        self._check = _Check(state.frame, state.pose, self._optimizers.fit(self._task(cameras)))
        self._take_check()

    def _take_check(self) -> None:
        """Store the verdict that has arrived, unless the pose was changed since."""
        check, editor = self._check, self._session.editor
        if check is None or not check.reply.done:
            return
        self._check = None
        index, verdict = check.frame.index, check.reply.result().verdict
        if not self._session.pose(check.frame).equals(check.pose):
            return
        if editor.project.writable:
            # A verdict changes no value, so it is not an undo step.
            self._context.save()
            editor.project.record_verdict(index, verdict)
            self._context.refresh()
        elif index == self._context.state.index:
            self._context.edit("Check the fit", {Key.verdict(index): verdict})
        self._context.change(busy=None)

    def _accept(self, run: ActiveRun, iterate: Iterate, verdict: FitVerdict | None = None) -> None:
        """Set the frame's pose to an iterate; all iterates of a run are one undo step."""
        state = self._context.state
        assert run.provenance is not None
        pose, free = run.pose(iterate).scene, run.task.free
        edits = self._session.edits(state.frame, pose, run.provenance, iterate.joint_std(), free)
        # An earlier verdict refers to another pose.
        edits[Key.verdict(state.index)] = verdict
        self._made = {**self._made, **edits}
        maps = Maps(iterate, run.cameras)
        self._context.edit("Optimize", edits, gesture=run, loss=float(iterate.loss), maps=maps)

    def _set_free(self, **changes: Any) -> None:
        self.end("Free parameters changed; Run starts from the current pose")
        self._context.change(free=replace(self._context.state.free, **changes), maps=None)

    def _set(self, **changes: Any) -> None:
        self._context.change(run=replace(self._context.state.run, **changes))


def _same(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """Whether inputs are the same objects, or equal settings; arrays are not compared."""
    return len(one) == len(other) and all(a is b or _equal(a, b) for a, b in zip(one, other, strict=True))


def _equal(one: object, other: object) -> bool:
    return type(one) is type(other) and not isinstance(one, Frame | SceneState | Pose) and one == other
