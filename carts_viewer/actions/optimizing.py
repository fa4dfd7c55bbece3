"""The optimizer: runs on the shown frame, solver settings, and free parameters."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from carts_core import optimization
from carts_core.errors import CartsError, SettingsError
from carts_core.project import Edits, FitVerdict, Key
from carts_core.settings import SolverName, SurfaceSolver
from carts_core.settings import solver as named_solver
from carts_core.settings.serialization import changed
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler
from carts_viewer.jobs.comparison import FitCheck
from carts_viewer.jobs.optimizers import ActiveRun, FrameTask, OptimizerFactory, scene_at
from carts_viewer.picture.layers import Layer
from carts_viewer.state import NETWORK, PRESETS, Curves, Maps, Observed, Phase, RefinedMasks, RunState, Scores

if TYPE_CHECKING:
    from carts_core.optimization import Iterate

_REASONS = {
    "iterations": "Done: the best iteration is the result",
    "not optimized": "Evaluated only: this solver does not optimize",
    "converged": "Ended: no step reduces the loss further",
    "failed": "Ended: the image contradicts the result",
    "start kept": "Initial pose kept: the optimized pose does not fit much better",
    "cancelled": "Cancelled",
}


class OptimizingHandler(Handler):
    """Handler that runs the optimizer, one iteration at a time."""

    def __init__(self, context: Context, optimizers: OptimizerFactory) -> None:
        super().__init__(context)
        context.run = self
        self._optimizers = optimizers
        self._check = FitCheck(context.session, optimizers)
        self._run: ActiveRun | None = None
        self._target = NETWORK
        """Target of the last run."""
        self._before: Edits | None = None
        """Edits that restore the frame to the start of the last run."""

    @property
    def active(self) -> bool:
        """Whether a run is in progress or paused."""
        return self._run is not None

    def wait_time(self) -> float | None:
        """Time until the next iteration is due [s]: 0 during a run, otherwise None."""
        return 0.0 if self._context.state.run.phase is Phase.RUNNING else None

    def advance(self) -> None:
        """Perform an iteration, if one is due."""
        if self._context.state.run.phase is Phase.RUNNING:
            self._iterate()

    def end(self, reason: str | None, *, save: bool = True) -> None:
        """End the run and save its pose; its curves are kept until the next run.

        Raises:
            ProjectError: the pose could not be saved.
        """
        if self._context.state.run.base_frame_gain is not None:
            self._set(base_frame_gain=None)
        if self._run is not None:
            self._run = None
            self._set(phase=Phase.IDLE, reason=reason)
            if save:
                self._context.save()

    def forget(self) -> None:
        """Discard the start of the run when another frame is shown."""
        self._before = None

    def map(self) -> None:
        """Compute the maps or refined masks of the chosen layer, if they are missing.

        Raises:
            CartsError: the maps cannot be computed.
        """
        state = self._context.state
        if state.layer is Layer.REFINED:
            self._refine()
        if state.layer not in (Layer.ATTENTION, Layer.SIMILARITY):
            return
        if state.maps is not None and state.camera in state.maps.cameras:
            return
        try:
            run = self._make((state.camera,))
            iterate = run.optimizer.step()
        except CartsError:
            # For example, the weights are missing. The layer is changed to avoid an attempt for every picture.
            self._context.change(layer=Layer.MASK)
            raise
        self._context.change(maps=None if iterate is None else Maps(iterate, run.cameras, of_run=False), busy=None)

    def _refine(self) -> None:
        """Refine the rendered masks of the shown cameras; during a gesture or a run, masks are shown as rendered."""
        state, context = self._context.state, self._context
        if state.unsaved or state.run.phase is Phase.RUNNING:
            return
        pose, frame = state.pose.scene, state.frame
        cameras = [state.camera] if not state.beside else [*frame.images]
        if all(state.refined_mask(pose, camera) is not None for camera in cameras):
            return
        try:
            predictor = optimization.NetworkPredictor(self._optimizers.prepare())
        except CartsError:
            context.change(layer=Layer.MASK)
            raise
        ignored = {camera: state.ignore_region_of(camera) for camera in cameras}
        regions = {camera: region.region() for camera, region in ignored.items() if region is not None}
        masks = {}
        for camera in cameras:
            backgrounds = optimization.Backgrounds.of(self._session.sequence, (camera,), state.domain)
            refiner = optimization.MaskRefiner(predictor, backgrounds)
            rendered = {camera: context.renderer.mask(pose, camera)}
            masks |= refiner.refine(scene_at(self._session.scene, pose), frame, pose, rendered, regions)
        context.change(refined=RefinedMasks(frame, pose, ignored, masks), busy=None)

    # ---- Intents ---------------------------------------------------------------------------------------------------

    def _on_Run(self, intent: intents.Run) -> None:
        if self._run is None:
            self._start()
        self._set(phase=Phase.RUNNING, reason=None)

    def _on_Pause(self, intent: intents.Pause) -> None:
        if self._context.state.run.phase is Phase.RUNNING:
            self._set(phase=Phase.PAUSED)

    def _on_RunOrPause(self, intent: intents.RunOrPause) -> None:
        self.handle(intents.Pause() if self._context.state.run.phase is Phase.RUNNING else intents.Run())

    def _on_Step(self, intent: intents.Step) -> None:
        if self._run is None:
            self._start()
            self._iterate()
        self._set(phase=Phase.PAUSED, reason=None)
        self._iterate()

    def _on_Reset(self, intent: intents.Reset) -> None:
        if self._run is not None:
            # The poses of the run are an unsaved draft.
            self._session.editor.drop()
        self.end(None)
        self._context.change(run=RunState())
        if self._before is not None:
            self._context.edit("Reset to the start of the run", self._before)

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

    def _make(self, cameras: tuple[str, ...]) -> ActiveRun:
        state, target = self._context.state, self._session.target(self._context.state.observed)
        self._target, ignore = target, self._session.ignored(state.index, cameras, target)
        task = FrameTask(
            self._session.sequence,
            state.index,
            state.domain,
            cameras,
            state.pose,
            state.settings,
            state.free,
            target,
            ignore,
        )
        provenance = self._optimizers.provenance(cameras, state.settings, state.free, target)
        return ActiveRun(self._optimizers.make(task), task, provenance)

    def _start(self) -> None:
        if self._context.state.settings_error is not None:
            raise SettingsError(self._context.state.settings_error)
        if self._context.state.solving:
            raise CartsError("Many frames are being solved. Wait, or stop solving first.")
        self._run = self._make(self._context.cameras)
        self._context.save()
        self._before = self._session.saved(self._context.state.index)
        run = RunState(Phase.RUNNING, start=self._context.state.pose.scene)
        self._context.change(run=run, playing=False, error=None, busy=None, unfamiliar=self._network_warnings())

    def _network_warnings(self) -> tuple[str, ...]:
        """Warnings about the network of the run."""
        state = self._context.state
        if self._target.observed.what != "network" or not isinstance(state.settings, SurfaceSolver):
            return ()
        scene = scene_at(self._session.scene, state.pose.scene)
        return self._optimizers.domain_warnings(
            self._session.sequence, scene, state.index, state.domain, self._context.cameras
        )

    def _iterate(self) -> None:
        run = self._run
        if run is None:
            return
        iterate = run.optimizer.step()
        if iterate is None:
            best, reason = run.optimizer.best, run.optimizer.stop_reason
            if best is not None:
                self._accept(run, best, self._verdict(run, best))
                curves = self._context.state.run.curves
                self._set(curves=replace(curves, loss=tuple(run.optimizer.comparable_losses()), comparable=True))
            self.end(_REASONS.get(reason or "", reason))
            self._set(base_frame_gain=run.optimizer.base_frame_gain())
            return
        self._accept(run, iterate)
        self._context.score()
        curves, best = self._context.state.run.curves, run.optimizer.best
        self._set(
            curves=Curves(
                (*curves.loss, float(iterate.loss)),
                tuple(progress.stage for progress in run.optimizer.history),
                False,
                (*curves.scores, self._context.state.scores or Scores()),
                (*curves.seconds, float(iterate.seconds)),
                best.index if best else 0,
            )
        )

    def _verdict(self, run: ActiveRun, end: "Iterate") -> FitVerdict | None:
        """Verdict at the end of a run; with several cameras, each camera is assessed individually."""
        own = run.verdict()
        if own is not None and (len(self._session.scene.cameras) == 1 or own.verdict == "failed"):
            return own
        state = self._context.state
        try:
            found = self._check.fit(state.index, state.domain, run.pose(end), state.settings, self._target).verdict
        except CartsError:
            # There is no surface network, and the solver does not need one.
            return own
        return found

    def _on_Assess(self, intent: intents.Assess) -> None:
        self.end("Stopped: a check of the fit was started")
        self._optimizers.report("Comparing the pose with the images")
        state = self._context.state
        target = self._session.target(state.observed)
        found = self._check.fit(state.index, state.domain, state.pose, state.settings, target)
        if self._session.editor.project.writable:
            # A verdict changes no value, so it is not an undo step.
            self._context.save()
            self._session.editor.project.record_verdict(state.index, found.verdict)
            self._context.refresh()
        else:
            self._context.edit("Check the fit", {Key.verdict(state.index): found.verdict})
        self._context.change(busy=None)

    def _accept(self, run: ActiveRun, iterate: "Iterate", verdict: FitVerdict | None = None) -> None:
        """Set the frame's pose to an iterate; all iterates of a run are one undo step."""
        state = self._context.state
        edits = self._session.edits(state.frame, run.pose(iterate).scene, run.provenance, iterate.joint_std())
        # An earlier verdict refers to another pose.
        edits[Key.verdict(state.index)] = verdict
        maps = Maps(iterate, run.cameras)
        self._context.edit("Optimize", edits, gesture=run, loss=float(iterate.loss), maps=maps)

    def _set_free(self, **changes: Any) -> None:
        self.end("Free parameters changed; Run starts from the current pose")
        self._context.change(free=replace(self._context.state.free, **changes), maps=None)

    def _set(self, **changes: Any) -> None:
        self._context.change(run=replace(self._context.state.run, **changes))
