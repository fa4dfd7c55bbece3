"""Shared state of the handlers: view state, recording and project, and checks of values from a browser."""

import math
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Protocol

from carts_core.errors import CartsError
from carts_core.model.keypoints import project_keypoints
from carts_core.model.scene import SceneState
from carts_core.project import Edits, Figures, Kind, Provenance, Source
from carts_core.project.values import WHOLE_PROJECT
from carts_core.settings import FreeParameters
from carts_viewer.actions.intents import Intent
from carts_viewer.picture.overlay import OverlayRenderer, with_imported
from carts_viewer.session import Session
from carts_viewer.state import Maps, ViewState


class OpenRun(Protocol):
    """The run of the optimizer on the shown frame."""

    def end(self, reason: str | None) -> None:
        """End the run, if any, and save its pose; `reason` is text for the user."""

    def forget(self) -> None:
        """Discard the start of the run when another frame is shown."""


class Context:
    """State that the handlers share, and edits on their behalf; used on the worker's thread only.

    Attributes:
        state: what the page shows.
        session: the recording and its project.
        renderer: renders poses.
        run: the run on the shown frame; None in the background.
    """

    run: OpenRun | None = None

    def __init__(self, state: ViewState, session: Session, renderer: OverlayRenderer) -> None:
        self.state = state
        self.session = session
        self.renderer = renderer
        self._editor = session.editor
        self._loss: float | None = None

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that a run uses."""
        names = tuple(camera.name for camera in self.session.scene.cameras)
        return names if self.state.every_camera else (self.state.camera,)

    def change(self, **changes: Any) -> None:
        """Replace fields of the state."""
        self.state = replace(self.state, **changes)

    def end_run(self, reason: str | None) -> None:
        """End the run on the shown frame, if there is one, and save its pose; `reason` is text for the user.

        Raises:
            ProjectError: the pose could not be saved.
        """
        if self.run is not None:
            self.run.end(reason)

    def set_pose(
        self,
        name: str,
        scene: SceneState,
        *,
        arms: tuple[str, ...] = (),
        gesture: object = None,
        source: Source = Source.HAND,
        pins: bool = False,
    ) -> None:
        """Set the pose of the shown frame; no run may be active.

        Args:
            name: name of the step in the history.
            scene: the pose.
            arms: the moved arms; empty for all arms.
            gesture: edits of the same gesture are one step, saved when it ends; None for a complete gesture.
            source: origin of the pose.
            pins: whether the pose was fitted to pins; otherwise all pins are removed.

        Raises:
            ProjectError: the edit could not be saved.
        """
        if not pins:
            self.remove_pins()
        edits = self.session.edits(self.state.frame, scene, Provenance(source), free=FreeParameters(arms=arms))
        self.edit(name, edits, gesture=gesture)

    def edit(
        self,
        name: str,
        edits: Edits,
        *,
        gesture: object = None,
        loss: float | None = None,
        maps: Maps | None = None,
    ) -> None:
        """Change the project; arguments and errors as in `set_pose`. `loss` and `maps` belong to the new pose."""
        if self._editor.gesture != gesture:
            self.save()
        self._loss = loss
        frames = sorted({key.frame for key in edits} - {WHOLE_PROJECT})
        where = "".join(f", frame {self.session.sequence.frame_ids[index]}" for index in frames)
        self._editor.draft(f"{name}{where}", edits, gesture or object())
        self.refresh(maps)
        if gesture is None:
            self.save()

    def save(self) -> None:
        """Save the unfinished gesture, if any, as one step.

        Raises:
            ProjectError: the gesture could not be saved.
        """
        if not self._editor.unsaved:
            return
        index, figures = self.state.index, {}
        if self._editor.view.figures(index) is None:
            self.score()
            found = Figures(self._loss, self.state.scores.dice if self.state.scores else None)
            figures = {} if found == Figures() else {index: found}
        self._editor.save(figures)
        self._follow()

    def _follow(self) -> None:
        """Update the fields that depend on the project."""
        editor = self._editor
        self.change(project=editor.view, unsaved=editor.unsaved, can_undo=editor.can_undo, can_redo=editor.can_redo)

    def leave_frame(self) -> None:
        """Save the shown frame before another one is shown. Errors as in `save`."""
        self.save()
        # In a read-only project the draft could not be saved.
        self._editor.drop()
        self._loss = None

    def refresh(self, maps: Maps | None = None) -> None:
        """Update the state from the project; an unchanged pose keeps its scores and maps."""
        before = self.state
        if not self.session.matched(self.state.frame):
            frame = self.session.frame(self.state.index, self.state.domain, self.state.camera)
            self.change(frame=frame, scores=None, maps=None)
        pose = self.session.pose(self.state.frame)
        if not pose.equals(self.state.pose):
            self.change(pose=pose, scores=None, maps=None)
            self._measure_pins()
        self.change(maps=maps or self.state.maps)
        self._follow()
        if self._ground_truth_masks(self.state) != self._ground_truth_masks(before):
            self.change(scores=None)
        if self.state.ignore_region != before.ignore_region:
            self.change(maps=None)

    @staticmethod
    def _ground_truth_masks(state: ViewState) -> tuple[object, ...]:
        """Masks that scores depend on: the corrected mask and imported masks."""
        record = state.project.records.get(state.index)
        entries = {} if record is None else record.entries
        others = [entry.value for key, entry in entries.items() if key.kind is Kind.IMPORTED_MASK]
        return state.mask_correction, *others

    def score(self) -> None:
        """Compare the pose with ground truth, unless already done; the project stores the first figures of a frame."""
        state = self.state
        if state.scores is not None:
            return
        if state.streaming:
            self.change(scores=self.renderer.scores(state.pose.scene, state.frame, state.camera))
            return
        frame = with_imported(state.frame, self.session.scene, self._editor.view)
        scores = self.renderer.scores(state.pose.scene, frame, state.camera, state.mask_correction)
        self.change(scores=scores)
        project = self._editor.project
        known = scores.dice is None or state.unsaved or project.state.figures(state.index) is not None
        if project.writable and not known and not state.playing:
            project.record_figures({state.index: Figures(dice=scores.dice)}, project.state)
            self.change(project=self._editor.view)

    def _measure_pins(self) -> None:
        """Update the residuals of the placed keypoints."""
        keypoints = self.state.keypoints
        if keypoints.pins:
            distances = []
            for pin in keypoints.pins:
                at = project_keypoints(self.session.scene, self.state.pose.scene, [pin.keypoint], pin.camera)[0]
                distances.append(math.dist(at.tolist(), pin.pixel))
            self.change(keypoints=replace(keypoints, residuals=tuple(distances)))

    def remove_pins(self) -> None:
        """Remove the placed keypoints."""
        if self.state.keypoints.pins:
            self.change(keypoints=replace(self.state.keypoints, pins=(), residuals=()))


def finite(value: float) -> float:
    """Return the number if it is finite.

    Raises:
        CartsError: the number is not finite.
    """
    if not math.isfinite(value):
        raise CartsError(f"{value} is not a finite number.")
    return float(value)


def clamped(value: float, low: float, high: float) -> float:
    """The number clamped to a range.

    Raises:
        CartsError: the number is not finite.
    """
    return min(max(finite(value), low), high)


def one_of(asked: str | None, now: str, known: Collection[str], what: str) -> str:
    """The requested name, by default the current one.

    Raises:
        CartsError: the name is unknown.
    """
    if asked is None:
        return now
    if asked not in known:
        raise CartsError(f"Unknown {what} {asked!r}. This sequence has: {', '.join(known)}.")
    return asked


class Handler:
    """Carries out intents by calling the method `_on_NAME` for the class NAME, similar to `ast.NodeVisitor`."""

    def __init__(self, context: Context) -> None:
        self._context, self._session = context, context.session

    def handle(self, intent: Intent) -> None:
        """Carry out an intent.

        Raises:
            CartsError: the intent cannot be carried out; the state stays valid.
        """
        if not self.takes(intent):
            raise CartsError(f"The viewer has no handler for {type(intent).__name__}; this is a bug.")
        getattr(self, f"_on_{type(intent).__name__}")(intent)

    def takes(self, intent: Intent) -> bool:
        """Whether this handler has a method for an intent."""
        return hasattr(self, f"_on_{type(intent).__name__}")
