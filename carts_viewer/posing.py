"""What intents about joints do: sliders, nudges, perturbations, and back to the measured values."""

import math
from functools import singledispatchmethod
from typing import TYPE_CHECKING

from carts_core.errors import CartsError
from carts_core.project import Key
from carts_viewer import intents as ask
from carts_viewer.checks import clamped, finite, unknown

if TYPE_CHECKING:
    from carts_viewer.controller import Controller

LARGEST_PERTURBATION = 30.0
"""[deg and mm]."""


class Poser:
    """The part of the controller that moves joints by hand."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._session = controller.session

    @singledispatchmethod
    def handle(self, intent: ask.Posing) -> None:
        """Do what an intent asks for.

        Raises:
            CartsError: with a text for people; the state is still a valid one.
        """
        raise unknown(intent)

    @handle.register
    def _(self, intent: ask.SetJoint) -> None:
        value = finite(intent.value)
        scene = self._session.with_joint(self._controller.state.pose.scene, intent.arm, intent.joint, value)
        self._controller.change(joint=(intent.arm, intent.joint))
        # All events of one joint until it is let go of are one step of undo.
        gesture = (ask.SetJoint, intent.arm, intent.joint)
        self._controller.edit(f"Move {self._joint_name()}", scene, gesture=gesture)

    @handle.register
    def _(self, intent: ask.ChooseJoint) -> None:
        joints = [(arm.name, joint) for arm in self._session.scene.arms for joint in range(len(arm.robot.joint_names))]
        following = joints[(joints.index(self._joint()) + 1) % len(joints)]
        chosen = intent.joint or following
        if chosen not in joints:
            raise CartsError(f"There is no joint {chosen!r}.")
        self._controller.change(joint=chosen)

    @handle.register
    def _(self, intent: ask.Nudge) -> None:
        arm, joint = self._joint()
        pose = self._controller.state.pose.scene
        by = clamped(intent.by, -LARGEST_PERTURBATION, LARGEST_PERTURBATION)
        step = math.radians(by) if self._session.joint_range(arm, joint).revolute else by / 1e3
        now = self._session.joints(pose)[arm][joint]
        self._controller.edit(f"Nudge {self._joint_name()}", self._session.with_joint(pose, arm, joint, now + step))

    @handle.register
    def _(self, intent: ask.BackToMeasured) -> None:
        self._controller.end_run("Stopped: the pose was changed by hand")
        names = [arm.name for arm in self._session.scene.arms] if intent.arm is None else [intent.arm]
        index = self._controller.state.index
        self._controller.stage("Back to measured", {Key.joints(index, name): None for name in names})

    @handle.register
    def _(self, intent: ask.Perturb) -> None:
        degrees = clamped(intent.degrees, 0.0, LARGEST_PERTURBATION)
        state = self._controller.state
        scene = self._session.perturbed(state.pose.scene, state.index, degrees, intent.seed)
        self._controller.edit(f"Perturb by {degrees:g}°", scene)

    def _joint(self) -> tuple[str, int]:
        return self._controller.state.joint or (self._session.scene.arms[0].name, 0)

    def _joint_name(self) -> str:
        arm, joint = self._joint()
        name = self._session.joint_range(arm, joint).joint
        return f"{arm} {name.removesuffix('_joint').replace('_', ' ')}"
