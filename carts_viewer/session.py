"""The recording that is open, and the poses that the user has given to its frames. No widgets, no optimizer."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from carts_core.data import Frame, FrameReader, Sequence
from carts_core.perturbation import perturb
from carts_core.scene import Arm, Scene, SceneState
from carts_viewer.state import Pose, Source

_KEPT_CHANGES = 200


@dataclass(frozen=True)
class JointRange:
    """What a joint may be set to."""

    arm: str
    joint: str
    revolute: bool
    lower: float
    """[rad] or [m]; a joint without limits may turn once round either way."""
    upper: float


@dataclass(frozen=True, eq=False)
class _Change:
    index: int
    before: Pose | None
    merges: object | None


class Session:
    """Frames of one sequence and this session's corrections of them.

    A frame's pose is the measured one until somebody corrects it; corrections outlive a change of frame, and neither
    camera nor domain touches them.
    """

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.scene: Scene = sequence.scene
        self.ranges = tuple(
            _range(arm, joint) for arm in self.scene.arms for joint in range(len(arm.robot.joint_names))
        )
        self._reader = FrameReader(sequence)
        self._corrected: dict[int, Pose] = {}
        self._changes: list[_Change] = []

    @property
    def undoable(self) -> int:
        """How many changes `undo` can take back."""
        return len(self._changes)

    def frame(self, index: int, domain: str, camera: str) -> Frame:
        """The frame with the image of that camera; those ahead of it are read in advance.

        Raises:
            SequenceError: the image is not usable.
        """
        return self._reader.frame(index, domain, camera)

    def close(self) -> None:
        """Stop reading frames in advance."""
        self._reader.close()

    def measured(self, frame: Frame) -> Pose:
        """The pose that the kinematics table gives."""
        return Pose(self.scene.state(frame.measured), Source.MEASURED)

    def pose(self, frame: Frame) -> Pose:
        """The frame's corrected pose, or the measured one."""
        return self._corrected.get(frame.index) or self.measured(frame)

    def correct(self, index: int, pose: Pose | None, *, merges: object | None = None) -> None:
        """Remember a pose for a frame (None: the measured one again), as one step of undo.

        Args:
            index: The frame.
            pose: Its new pose.
            merges: Consecutive corrections of the same frame with an equal, not-None value here are one step; a drag
                sends the same value with each of its events.
        """
        last = self._changes[-1] if self._changes else None
        if last is None or merges is None or (last.index, last.merges) != (index, merges):
            self._changes.append(_Change(index, self._corrected.get(index), merges))
            del self._changes[:-_KEPT_CHANGES]
        self._set(index, pose)

    def undo(self) -> int | None:
        """Take back the last correction; gives the index of its frame, or None when there is nothing to undo."""
        if not self._changes:
            return None
        change = self._changes.pop()
        self._set(change.index, change.before)
        return change.index

    def joint_range(self, arm: str, joint: int) -> JointRange:
        """What the joint with this index of this arm may be set to.

        Raises:
            RobotError: no such arm.
            IndexError: no such joint.
        """
        names = self.scene.arm(arm).robot.joint_names
        return next(r for r in self.ranges if (r.arm, r.joint) == (arm, names[joint]))

    def with_joint(self, state: SceneState, arm: str, joint: int, value: float) -> SceneState:
        """The state with one joint [rad or m] set, clamped to its limits."""
        limits = self.joint_range(arm, joint)
        values = {name: joints.copy() for name, joints in self.joints(state).items()}
        values[arm][joint] = min(max(value, limits.lower), limits.upper)
        return self.with_joints(state, values)

    def with_joints(self, state: SceneState, values: dict[str, Float[np.ndarray, " dofs"]]) -> SceneState:
        """The state with the joint positions [rad, m] of the named arms replaced, not clamped."""
        return replace(
            state,
            joint_positions=tuple(
                torch.as_tensor(values[arm.name], dtype=torch.float32) if arm.name in values else old
                for arm, old in zip(self.scene.arms, state.joint_positions, strict=True)
            ),
        )

    def perturbed(self, state: SceneState, index: int, degrees: float, seed: int) -> SceneState:
        """The state with every measured joint moved by `degrees` [deg] or as many millimetres.

        The same seed gives a frame the same signs here and in `carts evaluate`.
        """
        joints = perturb(self.scene, self.joints(state), degrees, (seed, index), self.sequence.measured_joints)
        return self.with_joints(state, joints)

    def joints(self, state: SceneState) -> dict[str, Float[np.ndarray, " dofs"]]:
        """Joint positions [rad, m] by arm name."""
        return {
            arm.name: values.numpy().astype(np.float64)
            for arm, values in zip(self.scene.arms, state.joint_positions, strict=True)
        }

    def corrected(self) -> dict[int, Pose]:
        """The corrected frames so far, by index."""
        return dict(self._corrected)

    def _set(self, index: int, pose: Pose | None) -> None:
        if pose is None or pose.source is Source.MEASURED:
            self._corrected.pop(index, None)
        else:
            self._corrected[index] = pose


def _range(arm: Arm, joint: int) -> JointRange:
    lower, upper = (float(value) for value in arm.robot.joint_limits[joint])
    revolute = arm.robot.joint_types[joint] == "revolute"
    # A joint without limits gets a slider with ends all the same: once round, or a metre, either way.
    room = math.pi if revolute else 1.0
    return JointRange(
        arm.name,
        arm.robot.joint_names[joint],
        revolute,
        lower if math.isfinite(lower) else -room,
        upper if math.isfinite(upper) else room,
    )
