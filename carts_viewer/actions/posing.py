"""Moving arms by hand: sliders, nudges, perturbations, and dragging a link in the picture."""

import math

from carts_core.errors import CartsError
from carts_core.model.keypoints import Keypoint, Pin, project_keypoints
from carts_core.model.scene import SceneState
from carts_core.optimization.keypoints import fit_keypoints
from carts_core.project import Key
from carts_viewer.actions import intents
from carts_viewer.actions.context import Context, Handler, clamped, finite

MAX_PERTURBATION = 30.0
"""Maximum perturbation [deg and mm]."""


class PosingHandler(Handler):
    """Handler of joints moved by hand."""

    def _on_SetJoint(self, intent: intents.SetJoint) -> None:
        value = finite(intent.value)
        scene = self._session.with_joint(self._context.state.pose.scene, intent.arm, intent.joint, value)
        self._context.change(joint=(intent.arm, intent.joint))
        # All changes of one joint until the slider is released are one undo step.
        gesture = (intents.SetJoint, intent.arm, intent.joint)
        self._set_pose(f"Move {self._joint_name()}", scene, (intent.arm,), gesture)

    def _on_ChooseJoint(self, intent: intents.ChooseJoint) -> None:
        joints = [(arm.name, joint) for arm in self._session.scene.arms for joint in range(len(arm.robot.joint_names))]
        following = joints[(joints.index(self._joint()) + 1) % len(joints)]
        chosen = intent.joint or following
        if chosen not in joints:
            raise CartsError(f"Unknown joint {chosen!r}.")
        self._context.change(joint=chosen)

    def _on_Nudge(self, intent: intents.Nudge) -> None:
        arm, joint = self._joint()
        pose = self._context.state.pose.scene
        by = clamped(intent.by, -MAX_PERTURBATION, MAX_PERTURBATION)
        step = math.radians(by) if self._session.ranges[arm][joint].revolute else by / 1e3
        now = self._session.joints(pose)[arm][joint]
        self._set_pose(f"Nudge {self._joint_name()}", self._session.with_joint(pose, arm, joint, now + step), (arm,))

    def _on_BackToMeasured(self, intent: intents.BackToMeasured) -> None:
        self._context.end_run("Stopped: the pose was changed by hand")
        names = [arm.name for arm in self._session.scene.arms] if intent.arm is None else [intent.arm]
        index = self._context.state.index
        self._context.edit("Back to measured", {Key.joints(index, name): None for name in names})

    def _on_Perturb(self, intent: intents.Perturb) -> None:
        degrees = clamped(intent.degrees, 0.0, MAX_PERTURBATION)
        state = self._context.state
        scene = self._session.perturbed(state.pose.scene, state.index, degrees, intent.seed)
        self._set_pose(f"Perturb by {degrees:g}°", scene)

    def _set_pose(self, name: str, scene: SceneState, arms: tuple[str, ...] = (), gesture: object = None) -> None:
        self._context.end_run("Stopped: the pose was changed by hand")
        self._context.set_pose(name, scene, arms=arms, gesture=gesture)

    def _joint(self) -> tuple[str, int]:
        return self._context.state.joint or (self._session.scene.arms[0].name, 0)

    def _joint_name(self) -> str:
        arm, joint = self._joint()
        name = self._session.ranges[arm][joint].joint
        return f"{arm} {name.removesuffix('_joint').replace('_', ' ')}"


_GRAB_DISTANCE = 15.0
"""Maximum distance from the arm at which a link can be grabbed [px]."""
_MIN_DRAG = 0.5
"""Minimum motion of the pointer that counts as a drag [px]."""


class DraggingHandler(Handler):
    """Handler of links that are dragged in the picture.

    Every pose of a gesture is solved from the pose at its start, so that the path does not matter and dragging back
    restores the pose.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._gesture: float | None = None
        self._frame = 0
        self._start: SceneState | None = None
        self._point: Keypoint | None = None
        """The dragged point; None if no arm was under the pointer."""

    def _on_DragLink(self, intent: intents.DragLink) -> None:
        if not all(map(math.isfinite, (*intent.start, *intent.end))):
            raise CartsError(f"{intent.start} to {intent.end} are not positions in the image.")
        if intent.gesture != self._gesture:
            self._take(intent)
        moved = intent.end[0] - intent.start[0], intent.end[1] - intent.start[1]
        point, start, context = self._point, self._start, self._context
        gesture = (intents.DragLink, intent.gesture)
        under_way = context.session.editor.gesture == gesture
        if point is None or start is None or context.state.index != self._frame:
            return
        if math.hypot(*moved) < _MIN_DRAG and not under_way:
            return
        scene, camera = context.session.scene, context.session.scene.camera(intent.camera)
        u, v = project_keypoints(scene, start, [point], camera.name)[0].tolist()
        # The displacement of the pointer is used: with its position, a link grabbed beside its outline would jump.
        pixel = _within(u + moved[0], camera.width), _within(v + moved[1], camera.height)
        fit = fit_keypoints(scene, start, [Pin(point, camera.name, pixel)])
        self._context.end_run("Stopped: the pose was changed by hand")
        link = point.name.removesuffix("_link").replace("_", " ")
        context.set_pose(f"Drag {point.arm} {link}", fit.state, arms=(point.arm,), gesture=gesture)

    def _take(self, intent: intents.DragLink) -> None:
        """Pick the link under the pointer."""
        state = self._context.state
        self._gesture, self._frame, self._start, self._point = intent.gesture, state.index, state.pose.scene, None
        self._point = self._context.renderer.pick(state.pose.scene, intent.camera, intent.start, _GRAB_DISTANCE)
        if self._point is None:
            raise CartsError("There is no arm under the pointer. Drag a link in the overlay.")


def _within(value: float, size: int) -> float:
    """The coordinate clamped to at most one image size beyond the image."""
    return min(max(value, -float(size)), 2.0 * size)
