"""History, review, corrections copied between frames, keypoints, and actions on filtered frames."""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from carts_core.errors import CartsError
from carts_core.model.keypoints import Pin, project_keypoints
from carts_core.model.scene import SceneState
from carts_core.optimization.keypoints import fit_keypoints
from carts_core.project import Change, Key, Review, ReviewState, Source, next_unreviewed, worst_first
from carts_core.project.values import MAX_NOTE_LENGTH
from carts_core.wording import counted
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler, clamped
from carts_viewer.actions.frame_filter import FrameFilter, matching_frames
from carts_viewer.picture.overlay import labelled_keypoints

_SETTLED = frozenset({ReviewState.ACCEPTED, ReviewState.REJECTED})
_REVIEW_STEPS = {
    ReviewState.UNTOUCHED: "Clear the review",
    ReviewState.OPTIMIZED: "Mark as optimized",
    ReviewState.NEEDS_WORK: "Mark as needing work",
    ReviewState.ACCEPTED: "Accept",
    ReviewState.REJECTED: "Reject",
}


class AnnotatingHandler(Handler):
    """Handler of history, review, copied corrections and keypoints."""

    def __init__(self, context: Context, show: Callable[..., None]) -> None:
        super().__init__(context)
        self._show = show
        self._keypoints = labelled_keypoints(context.session.scene)
        self._held: str | None = None
        """Label of the dragged keypoint."""
        self._pinned_from: SceneState | None = None
        """The pose before the first of the current pins."""
        self._fitted: SceneState | None = None
        """The pose fitted to the current pins."""
        self._worst: int | None = None
        """Frame last shown by `ShowWorst`; None before its first use."""

    def released(self) -> None:
        """Handle the release of the pointer."""
        self._held = None

    # ---- History ---------------------------------------------------------------------------------------------------

    def _on_Undo(self, intent: intents.Undo) -> None:
        self._finish("Stopped: undo")
        self._changed(self._session.editor.undo())

    def _on_Redo(self, intent: intents.Redo) -> None:
        self._finish("Stopped: redo")
        self._changed(self._session.editor.redo())

    def _on_GoToStep(self, intent: intents.GoToStep) -> None:
        self._finish("Stopped: undo")
        self._changed(self._session.editor.go_to(intent.position))

    def _finish(self, reason: str) -> None:
        self._context.end_run(reason)
        self._context.save()

    def _changed(self, change: Change | None) -> None:
        self._context.remove_pins()
        frames = () if change is None else change.frames
        index = self._context.state.index
        # Show a frame that has changed.
        self._show(index=index if index in frames or not frames else frames[0], again=True)

    # ---- Review ----------------------------------------------------------------------------------------------------

    def _on_SetReview(self, intent: intents.SetReview) -> None:
        self._review(intent.state)

    def _on_SetNote(self, intent: intents.SetNote) -> None:
        index = self._context.state.index
        state = self._session.editor.view.review(index).state
        self._mark("Note", Review(state, str(intent.note)[:MAX_NOTE_LENGTH]), gesture=(intents.SetNote, index))

    def _on_AcceptAndNext(self, intent: intents.AcceptAndNext) -> None:
        self._context.change(notice=None)
        self._review(ReviewState.ACCEPTED)
        state = self._context.state
        within = state.part if state.index in state.part else None
        index = next_unreviewed(state.project, state.index, within=within)
        if index is not None:
            self._go(index)
            return
        # It is not an error if there is no next frame.
        where = " of the range" if within is not None and state.range is not None else ""
        count = len(within or range(len(self._session.sequence)))
        self._context.change(notice=f"All {count} frames{where} are reviewed.")

    def _on_ShowUnreviewed(self, intent: intents.ShowUnreviewed) -> None:
        state = self._context.state
        index = next_unreviewed(state.project, state.index, 1 if intent.step > 0 else -1)
        if index is None:
            raise CartsError("All frames are reviewed.")
        self._go(index)

    def _on_ShowWorst(self, intent: intents.ShowWorst) -> None:
        state = self._context.state
        project = state.project
        frames = range(len(project.identity.frame_ids))
        open_ones = [i for i in frames if i == state.index or project.review(i).state not in _SETTLED]
        order = worst_first(project, open_ones)
        if len(order) == 1:
            raise CartsError("All other frames are accepted or rejected.")
        # After other navigation, start with the worst frame; otherwise continue from the shown frame.
        begins = self._worst != state.index and order[0] != state.index
        place = 0 if begins else (order.index(state.index) + (1 if intent.step > 0 else -1)) % len(order)
        self._go(order[place])
        self._worst = order[place]

    def _review(self, state: ReviewState) -> None:
        note = self._session.editor.view.review(self._context.state.index).note
        self._mark(_REVIEW_STEPS[state], Review(state, note))

    def _mark(self, name: str, review: Review, *, gesture: object = None) -> None:
        """Set the review of the shown frame, and end the run on it."""
        self._context.end_run("Stopped: the frame was reviewed")
        # An empty review is stored as None, so that clearing it again adds no step.
        edits = {Key.review(self._context.state.index): None if review == Review() else review}
        self._context.edit(name, edits, gesture=gesture)

    def _go(self, index: int) -> None:
        self._context.change(playing=False)
        self._show(index=index)

    # ---- Corrections -----------------------------------------------------------------------------------------------

    def _on_CopyCorrection(self, intent: intents.CopyCorrection) -> None:
        state = self._context.state
        index = state.index + (1 if intent.step > 0 else -1)
        if not 0 <= index < len(self._session.sequence):
            side = "after" if intent.step > 0 else "before"
            raise CartsError(f"There is no frame {side} frame {state.frame.frame_id}.")
        source = self._session.sequence.frame(index, cameras=[])
        scene = self._session.copied(state.frame, source)
        self._context.end_run("Stopped: the pose was changed by hand")
        self._context.set_pose(f"Copy from frame {source.frame_id}", scene, source=Source.PROPAGATED)

    def _on_ShowKeypoints(self, intent: intents.ShowKeypoints) -> None:
        shown = self._context.state.keypoints
        self._context.change(keypoints=replace(shown, shown=not shown.shown if intent.on is None else intent.on))

    def _on_ChooseKeypoint(self, intent: intents.ChooseKeypoint) -> None:
        if intent.label is not None and intent.label not in self._keypoints:
            raise CartsError(f"Unknown keypoint {intent.label!r}. Choose one of: {', '.join(self._keypoints)}.")
        self._context.change(keypoints=replace(self._context.state.keypoints, chosen=intent.label))

    def _on_RemovePins(self, intent: intents.RemovePins) -> None:
        self._context.remove_pins()

    def _on_PointAt(self, intent: intents.PointAt) -> None:
        self._context.end_run("Stopped: the pose was changed by hand")
        state = self._context.state
        camera = self._session.scene.camera(intent.camera or state.camera)
        if not (math.isfinite(intent.u) and math.isfinite(intent.v)):
            raise CartsError(f"({intent.u}, {intent.v}) is not a position in the image.")
        pixel = min(max(intent.u, 0.0), float(camera.width)), min(max(intent.v, 0.0), float(camera.height))
        self._held = self._held or state.keypoints.chosen or self._nearest(pixel, camera.name)
        pin = Pin(self._keypoints[self._held], camera.name, pixel)
        others = [old for old in state.keypoints.pins if (old.keypoint, old.camera) != (pin.keypoint, pin.camera)]
        if not state.keypoints.pins or self._pinned_from is None or self._moved_since(state.pose.scene):
            self._pinned_from = state.pose.scene
        pins = (*others, pin)
        fit = fit_keypoints(self._session.scene, self._pinned_from, pins)
        self._fitted = fit.state
        placed = replace(state.keypoints, shown=True, pins=pins, residuals=fit.residuals)
        self._context.change(keypoints=placed)
        gesture = (intents.PointAt, pin.keypoint, pin.camera)
        arms = tuple({pin.keypoint.arm for pin in pins})
        self._context.set_pose(f"Place {self._held}", fit.state, arms=arms, gesture=gesture, pins=True)

    def _moved_since(self, scene: SceneState) -> bool:
        """Whether arms or cameras were moved, for example by a run or a calibration, since arms were fitted to pins."""
        if self._fitted is None:
            return True
        pairs = zip(_moving(self._fitted), _moving(scene), strict=True)
        return not all(np.allclose(one, other, atol=1e-5) for one, other in pairs)

    def _nearest(self, pixel: tuple[float, float], camera: str) -> str:
        state = self._context.state
        points = list(self._keypoints.values())
        shown = project_keypoints(self._session.scene, state.pose.scene, points, camera)
        distances = np.nan_to_num(np.linalg.norm(shown - pixel, axis=-1), nan=math.inf)
        return list(self._keypoints)[int(distances.argmin())]


def _moving(scene: SceneState) -> tuple[np.ndarray, ...]:
    """Joint positions and calibration of a pose."""
    return (*scene.joint_positions, scene.T_world_base, scene.T_camera_world, scene.intrinsics)


_MAX_TEXT = 200
"""Maximum length of a condition's text [characters]."""


class FilterHandler(Handler):
    """Handler of the frame filter."""

    def __init__(self, context: Context, show: Callable[..., None]) -> None:
        super().__init__(context)
        self._show = show

    def _on_SetFilter(self, intent: intents.SetFilter) -> None:
        if intent.name not in [field.name for field in fields(FrameFilter)]:
            raise CartsError(f"Frames cannot be filtered by {intent.name!r}.")
        value: Any = clamped(intent.value, 0.0, 1.0) if intent.name == "dice" else str(intent.value)[:_MAX_TEXT]
        self._context.change(filter=replace(self._context.state.filter, **{intent.name: value}))

    def _on_ClearFilter(self, intent: intents.ClearFilter) -> None:
        self._context.change(filter=FrameFilter())

    def _on_ShowMatching(self, intent: intents.ShowMatching) -> None:
        state = self._context.state
        frames = self._found()
        if intent.step > 0:
            index = next((frame for frame in frames if frame > state.index), frames[0])
        else:
            index = next((frame for frame in reversed(frames) if frame < state.index), frames[-1])
        self._context.change(playing=False)
        self._show(index=index)

    def _on_ReviewMatching(self, intent: intents.ReviewMatching) -> None:
        self._review_all(self._found(), intent.state)

    def _on_ReviewFrames(self, intent: intents.ReviewFrames) -> None:
        count = len(self._context.session.sequence)
        frames = sorted({index for index in intent.frames if 0 <= index < count})
        if not frames:
            raise CartsError(f"None of the {len(intent.frames)} frames is in this recording of {count} frames.")
        self._review_all(frames, intent.state)

    def _review_all(self, frames: list[int], state: ReviewState) -> None:
        """Set the review state of frames as one undo step."""
        project = self._context.session.editor.view
        self._context.end_run("Stopped: many frames were reviewed")
        edits: dict[Key[Any], Any] = {}
        for index in frames:
            review = Review(state, project.review(index).note)
            edits[Key.review(index)] = None if review == Review() else review
        # Applied without the context, which would name every frame in the step.
        self._context.save()
        of = " of" if state is ReviewState.UNTOUCHED else ""
        self._context.session.editor.apply(f"{_REVIEW_STEPS[state]}{of} {counted(len(frames), 'frame')}", edits)
        self._context.refresh()

    def _found(self) -> list[int]:
        frames = matching_frames(self._context.session.editor.view, self._context.state.filter)
        if not frames:
            raise CartsError("No frame matches the filter. Relax or clear its conditions.")
        return frames
