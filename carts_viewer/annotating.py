"""What intents about the project do: history, review, corrections between frames, keypoints."""

import math
from dataclasses import replace
from functools import singledispatchmethod
from typing import TYPE_CHECKING

from carts_core.errors import CartsError
from carts_core.keypoints import project_keypoints
from carts_core.optimization.keypoints import Pin, fit_keypoints
from carts_core.project import Review, ReviewState, Source, next_unreviewed, worst_first
from carts_core.project.values import LONGEST_NOTE
from carts_core.scene import SceneState
from carts_viewer import intents as ask
from carts_viewer.checks import unknown
from carts_viewer.marks import labelled_keypoints

if TYPE_CHECKING:
    from carts_viewer.controller import Controller

_SETTLED = frozenset({ReviewState.ACCEPTED, ReviewState.REJECTED})
_REVIEW_STEPS = {
    ReviewState.UNTOUCHED: "Clear the review",
    ReviewState.OPTIMIZED: "Mark as optimized",
    ReviewState.NEEDS_WORK: "Mark as needing work",
    ReviewState.ACCEPTED: "Accept",
    ReviewState.REJECTED: "Reject",
}


class Annotator:
    """The part of the controller that the project is about."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._session = controller.session
        self._keypoints = labelled_keypoints(controller.session.scene)
        self._held: str | None = None
        """The keypoint under somebody's pointer."""
        self._pinned_from: SceneState | None = None
        """The pose before the first of the present pins."""

    @singledispatchmethod
    def handle(self, intent: ask.Annotation) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    def released(self) -> None:
        """The pointer was let go of."""
        self._held = None

    # ---- History ---------------------------------------------------------------------------------------------------

    @handle.register
    def _(self, intent: ask.Undo) -> None:
        self._finish("Stopped by undo")
        self._go_to(self._session.editor.view.position - 1)

    @handle.register
    def _(self, intent: ask.Redo) -> None:
        self._finish("Stopped by redo")
        self._go_to(self._session.editor.view.position + 1)

    @handle.register
    def _(self, intent: ask.GoToStep) -> None:
        self._finish("Stopped by undo")
        self._go_to(intent.position)

    def _finish(self, reason: str) -> None:
        self._controller.end_run(reason)
        self._controller.save()

    def _go_to(self, position: int) -> None:
        change = self._session.editor.go_to(position)
        self._controller.forget_pins()
        frames = () if change is None else change.frames
        index = self._controller.state.index
        # What changes should be seen, wherever it is.
        self._controller.show(index=index if index in frames or not frames else frames[0], again=True)

    # ---- Review ----------------------------------------------------------------------------------------------------

    @handle.register
    def _(self, intent: ask.SetReview) -> None:
        self._review(intent.state)

    @handle.register
    def _(self, intent: ask.SetNote) -> None:
        state = self._controller.state
        review = Review(state.review.state, str(intent.note)[:LONGEST_NOTE])
        self._controller.mark("Note", review, gesture=(ask.SetNote, state.index))

    @handle.register
    def _(self, intent: ask.AcceptAndNext) -> None:
        self._review(ReviewState.ACCEPTED)
        # Whoever accepts the last frame is done, which is no error.
        if next_unreviewed(self._controller.state.project, self._controller.state.index) is not None:
            self.handle(ask.ShowUnreviewed())

    @handle.register
    def _(self, intent: ask.ShowUnreviewed) -> None:
        state = self._controller.state
        index = next_unreviewed(state.project, state.index, 1 if intent.step > 0 else -1)
        if index is None:
            raise CartsError("Every frame has been reviewed.")
        self._go(index)

    @handle.register
    def _(self, intent: ask.ShowWorse) -> None:
        state = self._controller.state
        project = state.project
        frames = range(len(project.identity.frame_ids))
        open_ones = [i for i in frames if i == state.index or project.review(i).state not in _SETTLED]
        order = worst_first(project, open_ones)
        place = order.index(state.index) + (1 if intent.step > 0 else -1)
        if len(order) == 1:
            raise CartsError("Every other frame is accepted or rejected.")
        # Whoever begins on a frame that is settled begins with the worst one.
        self._go(order[place % len(order)])

    def _review(self, state: ReviewState) -> None:
        note = self._controller.state.review.note
        self._controller.mark(_REVIEW_STEPS[state], Review(state, note))

    def _go(self, index: int) -> None:
        self._controller.change(playing=False)
        self._controller.show(index=index)

    # ---- Corrections -----------------------------------------------------------------------------------------------

    @handle.register
    def _(self, intent: ask.CopyCorrection) -> None:
        state = self._controller.state
        index = state.index + (1 if intent.step > 0 else -1)
        if not 0 <= index < len(self._session.sequence):
            side = "after" if intent.step > 0 else "before"
            raise CartsError(f"There is no frame {side} frame {state.frame.frame_id} to copy from.")
        source = self._session.sequence.frame(index, cameras=[])
        scene = self._session.copied(state.frame, source)
        self._controller.edit(f"Copy from frame {source.frame_id}", scene, source=Source.PROPAGATED)

    @handle.register
    def _(self, intent: ask.ShowKeypoints) -> None:
        shown = self._controller.state.keypoints
        self._controller.change(keypoints=replace(shown, shown=not shown.shown if intent.on is None else intent.on))

    @handle.register
    def _(self, intent: ask.ChooseKeypoint) -> None:
        if intent.label is not None and intent.label not in self._keypoints:
            raise CartsError(f"There is no keypoint {intent.label!r}; there are: {', '.join(self._keypoints)}.")
        self._controller.change(keypoints=replace(self._controller.state.keypoints, chosen=intent.label))

    @handle.register
    def _(self, intent: ask.ForgetPins) -> None:
        self._controller.forget_pins()

    @handle.register
    def _(self, intent: ask.PointAt) -> None:
        self._controller.end_run("Stopped: the pose was changed by hand")
        state = self._controller.state
        camera = self._session.scene.camera(state.camera)
        if not (math.isfinite(intent.u) and math.isfinite(intent.v)):
            raise CartsError(f"({intent.u}, {intent.v}) is no place in the image.")
        pixel = min(max(intent.u, 0.0), float(camera.width)), min(max(intent.v, 0.0), float(camera.height))
        self._held = self._held or state.keypoints.chosen or self._nearest(pixel)
        pin = Pin(self._keypoints[self._held], camera.name, pixel)
        others = [old for old in state.keypoints.pins if (old.keypoint, old.camera) != (pin.keypoint, pin.camera)]
        if not state.keypoints.pins or self._pinned_from is None:
            self._pinned_from = state.pose.scene
        pins = (*others, pin)
        fit = fit_keypoints(self._session.scene, self._pinned_from, pins)
        placed = replace(state.keypoints, shown=True, pins=pins, residuals=fit.residuals)
        self._controller.change(keypoints=placed)
        gesture = (ask.PointAt, pin.keypoint, pin.camera)
        self._controller.edit(f"Place {self._held}", fit.state, gesture=gesture, pins=True)

    def _nearest(self, pixel: tuple[float, float]) -> str:
        state = self._controller.state
        points = list(self._keypoints.values())
        shown = project_keypoints(self._session.scene, state.pose.scene, points, state.camera)
        distances = (shown - shown.new_tensor(pixel)).norm(dim=-1).nan_to_num(math.inf)
        return list(self._keypoints)[int(distances.argmin())]
