"""Holds the state, and hands every intent to the part that knows what to do with it.

Runs on the worker's thread alone, knows neither threads nor widgets.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

from carts_core.errors import CartsError
from carts_core.project import Edits, Figures, Key, Provenance, Review, Source
from carts_core.project.keys import WHOLE_PROJECT
from carts_core.scene import SceneState
from carts_viewer import intents as ask
from carts_viewer.annotating import Annotator
from carts_viewer.browsing import Browser
from carts_viewer.checks import unknown
from carts_viewer.exporting import Exporter
from carts_viewer.optimizing import Runner
from carts_viewer.painting import Brushwork
from carts_viewer.picture import Painter
from carts_viewer.posing import Poser
from carts_viewer.propagating import Propagator
from carts_viewer.running import OptimizerFactory
from carts_viewer.session import Session
from carts_viewer.state import Maps, ViewState

WATCH_EVERY = 1.0
"""How often the project's file is looked after while nothing is edited [s]."""

Deliver = Callable[[int, str, bytes], None]
"""Sends a file to a tab: client id, file name, content."""


class Controller:
    """Holds the state and changes it: at once in `handle`, bit by bit in `advance`.

    Attributes:
        state: what the page shows.
        session: the recording and its project.
        painter: renders poses.
        deliver: sends a file to a tab.
    """

    def __init__(
        self, state: ViewState, session: Session, painter: Painter, optimizers: OptimizerFactory, deliver: Deliver
    ) -> None:
        self.state = state
        self.session = session
        self.painter = painter
        self.deliver = deliver
        self._editor = session.editor
        self._loss: float | None = None
        self._watch_at = 0.0
        self._incident: str | None = None
        self._browser = Browser(self)
        self._annotator = Annotator(self)
        self._runner = Runner(self, optimizers)
        self._propagator = Propagator(self, optimizers)
        self._exporter = Exporter(self)
        self._parts: dict[type[ask.Intent], Callable[[Any], None]] = {
            ask.Browsing: self._browser.handle,
            ask.Posing: Poser(self).handle,
            ask.Optimizing: self._runner.handle,
            ask.Annotation: self._annotator.handle,
            ask.Propagating: self._propagator.handle,
            ask.Exporting: self._exporter.handle,
            ask.Painting: Brushwork(self).handle,
            ask.Refresh: lambda _: self.change(),
            # Nothing to do: it has woken the worker, which now may send the next overlay.
            ask.Drawn: lambda _: None,
            ask.Released: lambda _: self._released(),
            ask.DismissError: lambda _: self.change(error=None),
        }

    # ---- What the worker calls -------------------------------------------------------------------------------------

    def handle(self, intent: ask.Intent) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        part = next((part for kind, part in self._parts.items() if isinstance(intent, kind)), None)
        if part is None:
            raise unknown(intent)
        part(intent)

    def patience(self) -> float | None:
        """How long nothing needs to be done unless somebody asks [s]; None for ever."""
        parts = (self._runner, self._propagator, self._exporter, self._browser)
        return min((wait for part in parts if (wait := part.patience()) is not None), default=None)

    def overdue_in(self) -> float | None:
        """How long until `advance` has to save a gesture that nobody has ended, or look after the file [s].

        None: for ever.
        """
        if not self._editor.project.writable:
            return None
        watch = max(0.0, self._watch_at - time.monotonic())
        draft = self._editor.overdue_in()
        return watch if draft is None else min(draft, watch)

    def advance(self) -> None:
        """Do one bit of what is going on: an iteration, a frame to be solved or exported, the next frame of playing."""
        self._runner.advance()
        self._propagator.advance()
        self._exporter.advance()
        self._browser.advance()
        if self._editor.overdue_in() == 0.0:
            self.save()
        self._watch()

    def _watch(self) -> None:
        """See now and then that the project's file is still there: nobody may be editing while it is deleted."""
        project = self._editor.project
        if project.writable and time.monotonic() >= self._watch_at:
            self._watch_at = time.monotonic() + WATCH_EVERY
            with suppress(CartsError):
                project.check()
        if project.incident != self._incident:
            self._incident = project.incident
            self.change(error=self._incident)

    def fail(self, error: Exception, *, stop: bool) -> None:
        """Show an error to the user.

        Args:
            error: What happened.
            stop: Stop whatever is going on; for errors of what is going on itself.
        """
        text = str(error) if isinstance(error, CartsError) else f"{type(error).__name__}: {error}"
        self.change(error=text, busy=None)
        if stop:
            self._runner.end("Stopped by an error", save=False)
            # What is solved is not lost to an error of something else; its own errors have saved it already.
            with suppress(CartsError):
                self._propagator.finish()
            self._exporter.cancel()
            self.change(playing=False)

    def close(self) -> None:
        """Save what is under way; exports are abandoned.

        Raises:
            CartsError: it could not be saved.
        """
        self._exporter.cancel()
        self._propagator.finish()
        self.save()

    def say(self, text: str | None) -> None:
        """Tell the user what is being prepared; None when nothing is."""
        self.change(busy=text)

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
        """Compute what the chosen layer shows beyond the pose; errors as `handle`."""
        self._runner.map()

    # ---- What the parts call ---------------------------------------------------------------------------------------

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that a run uses."""
        names = tuple(camera.name for camera in self.session.scene.cameras)
        return names if self.state.every_camera else (self.state.camera,)

    def change(self, **changes: Any) -> None:
        """Replace fields of the state."""
        self.state = replace(self.state, **changes)

    def show(self, *, index: int, again: bool = False) -> None:
        """Go to another frame; arguments and errors as `Browser.show`."""
        self._browser.show(index=index, again=again)

    def end_run(self, reason: str | None) -> None:
        """Drop the optimizer and save where it is. Errors as `save`."""
        self._runner.end(reason)

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
    ) -> None:
        """Change the project; arguments and errors as `edit`, for any edits.

        Args:
            name: of the step in the history.
            edits: what changes.
            gesture: see `edit`.
            loss: the optimizer's, at the new pose.
            maps: what the optimizer saw there.
        """
        if self._editor.gesture != gesture:
            self.save()
        self._loss = loss
        frames = sorted({key.frame for key in edits} - {WHOLE_PROJECT})
        where = "".join(f", frame {self.session.sequence.frame_ids[index]}" for index in frames)
        self._editor.draft(f"{name}{where}", edits, gesture or object())
        self.refresh(maps)
        if gesture is None:
            self.save()

    def mark(self, name: str, review: Review, *, gesture: object = None) -> None:
        """Say something about the shown frame, which ends a run. Arguments and errors as `edit`."""
        self.end_run("Stopped: the frame was reviewed")
        # What says nothing is none, so that clearing what is clear is no step.
        self.stage(name, {Key.review(self.state.index): None if review == Review() else review}, gesture=gesture)

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

    def leave_frame(self) -> None:
        """Save the shown frame before another one is shown. Errors as `save`."""
        self.save()
        # What a project that takes no edits could not save was for looking at only.
        self._editor.drop()
        self._runner.forget()
        self._loss = None

    def refresh(self, maps: Maps | None = None) -> None:
        """Bring the state up to date with the project; a pose that is the same keeps its scores and maps."""
        before = self.state
        if not self.session.matched(self.state.frame):
            frame = self.session.frame(self.state.index, self.state.domain, self.state.camera)
            self.change(frame=frame, scores=None, maps=None)
        pose = self.session.pose(self.state.frame)
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

    def _released(self) -> None:
        self._annotator.released()
        if self.state.time_error is not None:
            # Whoever leaves the field means what is in it.
            self.change(error=self.state.time_error, time_error=None)
        # A run is no gesture of a hand, so nobody's letting go of something ends it.
        if not self._runner.active:
            self.save()
