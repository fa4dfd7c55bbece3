"""What intents about joints do: sliders, nudges, perturbations, and back to the measured values."""

import math
from functools import singledispatchmethod

from carts_core.errors import CartsError
from carts_core.model.scene import SceneState
from carts_core.project import Key
from carts_viewer import intents
from carts_viewer.checks import clamped, finite, unknown
from carts_viewer.context import Context, OpenRun

LARGEST_PERTURBATION = 30.0
"""[deg and mm]."""


class PosingHandler:
    """The handler that moves joints by hand."""

    def __init__(self, context: Context, run: OpenRun) -> None:
        self._context = context
        self._open_run = run
        self._session = context.session

    @singledispatchmethod
    def handle(self, intent: intents.Posing) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    @handle.register
    def _(self, intent: intents.SetJoint) -> None:
        value = finite(intent.value)
        scene = self._session.with_joint(self._context.state.pose.scene, intent.arm, intent.joint, value)
        self._context.change(joint=(intent.arm, intent.joint))
        # All events of one joint until it is let go of are one step of undo.
        gesture = (intents.SetJoint, intent.arm, intent.joint)
        self._set_pose(f"Move {self._joint_name()}", scene, gesture=gesture)

    @handle.register
    def _(self, intent: intents.ChooseJoint) -> None:
        joints = [(arm.name, joint) for arm in self._session.scene.arms for joint in range(len(arm.robot.joint_names))]
        following = joints[(joints.index(self._joint()) + 1) % len(joints)]
        chosen = intent.joint or following
        if chosen not in joints:
            raise CartsError(f"There is no joint {chosen!r}.")
        self._context.change(joint=chosen)

    @handle.register
    def _(self, intent: intents.Nudge) -> None:
        arm, joint = self._joint()
        pose = self._context.state.pose.scene
        by = clamped(intent.by, -LARGEST_PERTURBATION, LARGEST_PERTURBATION)
        step = math.radians(by) if self._session.joint_range(arm, joint).revolute else by / 1e3
        now = self._session.joints(pose)[arm][joint]
        self._set_pose(f"Nudge {self._joint_name()}", self._session.with_joint(pose, arm, joint, now + step))

    @handle.register
    def _(self, intent: intents.BackToMeasured) -> None:
        self._open_run.end("Stopped: the pose was changed by hand")
        names = [arm.name for arm in self._session.scene.arms] if intent.arm is None else [intent.arm]
        index = self._context.state.index
        self._context.edit("Back to measured", {Key.joints(index, name): None for name in names})

    @handle.register
    def _(self, intent: intents.Perturb) -> None:
        degrees = clamped(intent.degrees, 0.0, LARGEST_PERTURBATION)
        state = self._context.state
        scene = self._session.perturbed(state.pose.scene, state.index, degrees, intent.seed)
        self._set_pose(f"Perturb by {degrees:g}°", scene)

    def _set_pose(self, name: str, scene: SceneState, gesture: object = None) -> None:
        self._open_run.end("Stopped: the pose was changed by hand")
        self._context.set_pose(name, scene, gesture=gesture)

    def _joint(self) -> tuple[str, int]:
        return self._context.state.joint or (self._session.scene.arms[0].name, 0)

    def _joint_name(self) -> str:
        arm, joint = self._joint()
        name = self._session.joint_range(arm, joint).joint
        return f"{arm} {name.removesuffix('_joint').replace('_', ' ')}"
