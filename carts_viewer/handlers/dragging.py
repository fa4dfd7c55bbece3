"""Dragging a link of an arm in the picture: its joints follow."""

import math

from carts_core.errors import CartsError
from carts_core.model.keypoints import Keypoint, project_keypoints
from carts_core.model.scene import SceneState
from carts_core.optimization.keypoints import Pin, fit_keypoints
from carts_viewer import intents
from carts_viewer.context import Context, OpenRun

_REACH = 15.0
"""How far from the arm a link can be taken [px]."""
_LEAST = 0.5
"""A pointer that has moved less was only pressed [px]."""


class DraggingHandler:
    """The handler that moves a link to where the pointer drags it.

    Every place of a gesture starts from the pose in which the link was taken, so that the way there does not matter and
    dragging it back undoes it.
    """

    def __init__(self, context: Context, run: OpenRun) -> None:
        self._context = context
        self._open_run = run
        self._gesture: float | None = None
        self._frame = 0
        self._start: SceneState | None = None
        self._point: Keypoint | None = None
        """What is dragged; None where nothing was under the pointer."""

    def handle(self, intent: intents.DragLink) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        if not all(map(math.isfinite, (*intent.start, *intent.end))):
            raise CartsError(f"{intent.start} to {intent.end} are no places in the image.")
        if intent.gesture != self._gesture:
            self._take(intent)
        moved = intent.end[0] - intent.start[0], intent.end[1] - intent.start[1]
        point, start, context = self._point, self._start, self._context
        gesture = (intents.DragLink, intent.gesture)
        under_way = context.session.editor.gesture == gesture
        if point is None or start is None or context.state.index != self._frame:
            return
        if math.hypot(*moved) < _LEAST and not under_way:
            return
        scene, camera = context.session.scene, context.session.scene.camera(intent.camera)
        u, v = project_keypoints(scene, start, [point], camera.name)[0].tolist()
        # Not the point but what the pointer has done to it, or a link that was taken beside its outline would jump.
        pixel = _within(u + moved[0], camera.width), _within(v + moved[1], camera.height)
        fit = fit_keypoints(scene, start, [Pin(point, camera.name, pixel)])
        self._open_run.end("Stopped: the pose was changed by hand")
        link = point.name.removesuffix("_link").replace("_", " ")
        context.set_pose(f"Drag {point.arm} {link}", fit.state, gesture=gesture)

    def _take(self, intent: intents.DragLink) -> None:
        """Take hold of what is under the pointer."""
        state = self._context.state
        self._gesture, self._frame, self._start, self._point = intent.gesture, state.index, state.pose.scene, None
        self._point = self._context.renderer.pick(state.pose.scene, intent.camera, intent.start, _REACH)
        if self._point is None:
            raise CartsError(
                "There is no arm under the pointer. Press where the overlay shows a link, hold Ctrl, and drag it."
            )


def _within(value: float, size: int) -> float:
    """A place at most one image beyond the image."""
    return min(max(value, -float(size)), 2.0 * size)
